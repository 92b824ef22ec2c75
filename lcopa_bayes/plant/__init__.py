"""The plant: elements, delayed drives, and the responses of records with their derivatives."""
