"""Simulation-based calibration: does the whole procedure cover what it says it covers?"""
