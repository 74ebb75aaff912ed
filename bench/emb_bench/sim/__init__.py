"""The simulated bench: sensors and delays, the brake as a CAN node, and open-loop simulation with sensitivities."""
