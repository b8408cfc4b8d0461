"""Limits of a confident pose that several files of the verdict use. Logarithms have base 10."""

# The NFA is an upper bound: on unrelated points, an exhaustive search stayed above 1 in 999 of 1000 cases and never
# fell below 0.1.
MOST_FALSE_ALARMS = -2.0  # largest log of the number of false alarms (NFA) [decades; derived]
# Smallest margin to every competing pose; by chance a wrong pose has it once in a thousand cases.
LEAST_MARGIN = 3.0  # [decades; convention]
MOST_MISSED = -3.0  # largest log probability that a better optimum was missed [decades; convention]
