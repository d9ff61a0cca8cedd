"""How a step of time is taken: `(scene, state, length) -> Step`, one scheme in a file."""
