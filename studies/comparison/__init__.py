"""Excitations against each other: on the same brakes, with the same noise, by what is estimated in the end."""
