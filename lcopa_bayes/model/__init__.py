"""The plant: elements, delayed drives, block-pulse algebra, responses and their derivatives."""
