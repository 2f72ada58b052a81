"""The version of dexsim; the wheel takes it from here."""

VERSION = "0.2.0"
