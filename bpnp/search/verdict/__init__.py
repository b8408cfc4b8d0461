"""Evidence for a verdict: the number of false alarms of a pose, its covariance and its competitors."""
