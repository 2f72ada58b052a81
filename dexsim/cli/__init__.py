"""The command `dexsim` and its jobs: settings from the command line, value checks, start-up printout, runs, replays.

The top floor: nothing in dexsim below it imports it.
"""
