"""What a record determines and what it leaves open: symmetries, curvature, profiles, draws, a verdict."""
