"""What an actor is worth: on brakes that it never saw, beside what needs no learning, against the known optimum."""
