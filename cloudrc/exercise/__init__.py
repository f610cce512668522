"""The exercise of docs/exercise.md: three files that students fill in, and the checks of them."""
