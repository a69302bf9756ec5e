"""The configuration: `schema` declares the keys, `kinds` and `rigs` parts of it; `load`, `render`, `edit` use them."""
