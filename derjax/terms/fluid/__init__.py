"""What the fluid does: drag on flagella and heads."""
