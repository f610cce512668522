"""Measure whether a policy survives a network: episodes of any environment of gymnasium."""
