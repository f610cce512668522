"""Measure and judge a recorded flight; write a report with numbers, figures and an HTML page."""
