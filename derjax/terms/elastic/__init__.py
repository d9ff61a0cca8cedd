"""Elastic energies: stretching, bending and twisting."""
