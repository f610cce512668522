"""Configuration: files go in, one frozen and complete description of an experiment comes out."""
