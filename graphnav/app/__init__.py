"""The program: its commands, what they print, and what they write."""
