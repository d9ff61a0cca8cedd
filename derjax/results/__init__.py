"""What comes out of a run: labelled data, numbers, figures and films."""
