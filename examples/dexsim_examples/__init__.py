"""Skills of a dexterous hand as tasks of their own: `dexsim train task=reorient|spin|turn|lift`."""
