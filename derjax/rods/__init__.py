"""What a rod is: vectors, topology, rest shape, state and frames."""
