"""Everything that protects the brake: shield, command limits, guard, state machine, watchdog."""
