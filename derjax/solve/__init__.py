"""How a step is solved for: contributions to a potential, Newton's method, linear systems."""
