"""From touches, frame by frame, to contacts: `tracker` is the front door."""
