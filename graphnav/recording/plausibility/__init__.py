"""Impossible rows: found before anything is solved, then masked or refused."""
