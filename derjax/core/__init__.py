"""What everything is made of: pytrees, how runs end, errors, and the computer."""
