"""A DAQ made of software: `device` speaks the USB protocol, `functionfs` puts it on a cable."""
