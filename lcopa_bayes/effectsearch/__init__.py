"""The loop: from a fit's residual to the effect it lacks, and the errors before and after."""
