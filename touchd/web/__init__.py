"""`touchd web`: look at a plate in a browser. A process of its own; it owns no device.

bus -> `hub` (newest message of each topic) -> `live` (WebSocket) -> static/live.js

- `server.py`: READ FIRST: opens all parts, builds the application, runs uvicorn, ends in order
- `guards.py`: **the one place** that admits or refuses: Host, Origin, token, methods, headers. A view has no check of
  its own: every POST needs the session that the token gives
- `site.py`: what all views share, in one object; runs another verb of touchd in a process of its own
- `hub.py`: newest messages to all browsers, slow ones too; `publish` sends a view's own state the same way
- a view is a module with `routes(site)`, listed in `server.VIEWS`: `live`, `calibrate`, `check`, `replay`
- `replayed.py`: the process that `replay` runs
- `static/`: one page. `texts.js` has **every** text; `main.js` routes `#view` to a module with `mount(root, page)`,
  listed there in `VIEWS`; `socket.js` reconnects and hands out messages by `type`; `page.css` has all colours

To add a view: a module with `routes(site)`; a file in static/ with `mount`; its texts in `texts.js`.
"""
