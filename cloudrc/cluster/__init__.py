"""Work with a release of the chart on Kubernetes: install it, fly missions, fetch recordings."""
