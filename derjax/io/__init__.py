"""Files: tables that other programs write, and results that are not to be lost."""
