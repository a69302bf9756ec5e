"""The configuration: `schema` declares every key, `load` reads them, `mistakes` explains, `render` writes."""
