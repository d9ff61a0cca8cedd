"""How scenes are described: files, parameters, checks, and what is built of them."""
