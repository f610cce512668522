"""Configuration files: read, complete and check them; the result is one frozen experiment."""
