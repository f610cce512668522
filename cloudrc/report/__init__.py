"""Judge and measure a recorded flight; write its report with numbers, figures and one page."""
