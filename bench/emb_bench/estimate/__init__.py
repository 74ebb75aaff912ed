"""Parameters of a brake from records of its experiments, with uncertainties and a verdict on the model first."""
