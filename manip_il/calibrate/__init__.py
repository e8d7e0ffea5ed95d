"""A real arm as equations, to compare with what was recorded of it."""
