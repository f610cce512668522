"""Read, complete and check configuration files; the result is one immutable experiment."""
