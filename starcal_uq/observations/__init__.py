"""The waist: the table of identified stars, its files and checks."""
