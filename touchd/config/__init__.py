"""The configuration: `schema` declares the keys, `kinds` their values; `load`, `render` and `mistakes` (explained)."""
