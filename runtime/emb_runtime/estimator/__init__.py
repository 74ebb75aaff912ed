"""Running estimate of the brake's parameters, and the speed loop that is built on it."""
