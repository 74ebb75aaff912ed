"""Terms of the results, each explained in a line."""

TERMS = {
    "sigma": "standard deviation",
    "chi2/n": "mean square of the residuals in sigmas, near 1 if the model is right",
    "identified": "the 95 % interval is closed, excludes zero and ends at no border of the search",
    "traded off": "the data tell two parameters well only together: an error of one makes up for that of the other",
}
"""Definition of each term."""
