"""The recording format: `format` reads and writes files, `data` holds them in memory."""
