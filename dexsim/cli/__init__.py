"""What the entry scripts share: settings from the command line, value checks, start-up printout, clear endings.

Part of the entry scripts, not of the library: nothing else in dexsim imports it.
"""
