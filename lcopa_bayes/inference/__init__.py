"""From parameters, priors and noise to a posterior and its optima."""
