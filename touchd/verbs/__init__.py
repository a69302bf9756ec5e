"""The verbs beside the daemon, one module each with a click command named `command`, imported on use."""
