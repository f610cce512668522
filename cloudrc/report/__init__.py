"""The report: a recorded flight becomes a verdict, numbers, figures and one page to read."""
