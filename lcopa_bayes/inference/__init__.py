"""From parameters, priors and noise to a posterior, its sampler, and graded draws."""
