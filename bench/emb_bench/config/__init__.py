"""Tables of the bench file that simulation and analysis read: plants, budgets, machines."""
