"""A trained scene as a folder: its files, views of its frames, renders, measurements and trainings."""
