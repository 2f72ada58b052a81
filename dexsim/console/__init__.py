"""Helpers of every command, whichever package it stands in: how it ends, what it is called, tables, progress, output
folders."""
