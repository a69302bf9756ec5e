"""Command line: `main` parses the options; each verb has a module of its name."""
