"""The page of a report: one HTML file with tables, plotly charts and every problem."""
