"""The training environment: brakes, sensors, shield and information, step by step, for one brake or many."""
