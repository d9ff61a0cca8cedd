"""What to film next: by how much more tracks would narrow the parameters."""
