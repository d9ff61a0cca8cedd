"""How time goes: scenes, stages, schemes, steps that adapt, frames."""
