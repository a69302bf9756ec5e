"""The configuration: `schema` declares every key, `load` reads them, `render` writes them out."""
