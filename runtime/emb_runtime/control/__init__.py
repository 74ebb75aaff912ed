"""One experiment: the control loop, when it may begin, when it ends, and its result."""
