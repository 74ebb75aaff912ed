"""Parameters of a brake from records of its experiments, with uncertainties; the model is validated first."""
