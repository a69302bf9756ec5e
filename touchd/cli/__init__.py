"""The command line: `main` reads it, and each verb is a module of its name."""
