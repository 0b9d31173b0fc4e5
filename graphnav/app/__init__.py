"""The program: commands, what they print, and what they leave on disk."""
