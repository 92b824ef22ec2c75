"""The verbs of the command line: what each does with its options, the values it tells, and the words."""
