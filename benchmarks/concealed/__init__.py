"""Concealed physics: cases whose missing effect `diagnose` cannot look up, from a plant that shares no code with it."""
