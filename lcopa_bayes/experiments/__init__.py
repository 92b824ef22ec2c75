"""What to measure next: candidate drives, the precision each promises, and its confirmation on the bench."""
