"""Static optics of a liquid-crystal phased array: far field, director and the chain from volts to angle."""
