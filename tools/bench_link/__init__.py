"""`make bench-link`: measure how exactly the relay follows its profiles."""
