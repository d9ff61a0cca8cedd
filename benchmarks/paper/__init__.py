"""The claims of the paper on two flagella, one by one: `python -m benchmarks.paper`."""
