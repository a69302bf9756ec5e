"""Where frames come from: `open` is the front door, `source` the contract."""
