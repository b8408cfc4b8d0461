"""Tables of test results for the terminal, with the published rows of the paper."""
