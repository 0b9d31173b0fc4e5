"""Rows that cannot be right: found before anything is solved, then masked or refused."""
