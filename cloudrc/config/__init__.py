"""Read and check configuration files, fill in defaults, and return an immutable experiment."""
