"""What a fit is: draws, predictions, step metrics, residuals, sensitivity, and the run folder."""
