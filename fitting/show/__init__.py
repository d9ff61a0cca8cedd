"""`derjax tracks`: what is understood of tracks, as a table, a picture and a dataset file."""
