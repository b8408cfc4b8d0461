"""What a verdict rests on: the number of false alarms of a pose, and how well its points fix it."""
