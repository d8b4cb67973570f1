"""Many sessions at once: where they are, a plan over them, its results, and questions in SQL."""
