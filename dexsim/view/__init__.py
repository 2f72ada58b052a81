"""Headless views: plots and videos."""
