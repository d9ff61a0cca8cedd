"""Steady states: solved for, instead of waited for."""
