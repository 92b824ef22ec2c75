"""Devices that are alike but not equal: what they share, how far they differ, which do not belong."""
