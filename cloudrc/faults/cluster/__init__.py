"""Faults in a Kubernetes cluster."""
