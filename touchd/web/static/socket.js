// The WebSocket: connects again after a loss, closes while the page is hidden, hands out messages by type.
const FIRST_WAIT_MS = 250, LONGEST_WAIT_MS = 8000;
const SAME_CLOCK_MS = 1000;
const SILENT_MS = 4000; // the server says something each second

// How old a message is, ms; null if its computer's clock is not that of the server.
function age(batch, message) {
  const byClock = (batch.now_ns - message.t_ns) / 1e6, byWall = batch.wall_ms - Date.parse(message.wall);
  return Math.abs(byClock - byWall) < SAME_CLOCK_MS ? Math.max(0, byClock) : null;
}

// Whether the server refuses to show anything without a session. A script learns the status of a request, not of a WebSocket.
async function refuses() {
  const answer = await fetch('live', { signal: AbortSignal.timeout(SILENT_MS) }).catch(() => null);
  return answer?.status === 401;
}

export class Feed {
  constructor() {
    this.state = 'connecting';
    this.last = {}; // newest message of each type
    this.stats = { batches: 0 };
    this.dataAgeMs = null;
    this.handlers = new Map();
    this.topics = new Set();
    this.waitMs = FIRST_WAIT_MS;
    this.silentS = null;
    this.batchAt = 0;
    document.addEventListener('visibilitychange', () => (document.hidden ? this.close() : this.open()));
    setInterval(() => {
      if (this.socket && this.batchAt && performance.now() - this.batchAt > SILENT_MS) this.socket.close();
    }, 1000);
    if (!document.hidden) this.open();
  }

  // Calls `handle` with each message of a type, and at once with the last one; returns what ends that.
  on(type, handle) {
    if (!this.handlers.has(type)) this.handlers.set(type, new Set());
    this.handlers.get(type).add(handle);
    if (this.last[type]) handle(this.last[type]);
    return () => this.handlers.get(type).delete(handle);
  }

  // Asks the daemon for a topic that it makes for nobody else; returns what ends that.
  ask(topic) {
    this.topics.add(topic);
    this.say();
    return () => { this.topics.delete(topic); this.say(); };
  }

  // Seconds since the daemon was heard, or null if it never was.
  silence() {
    return this.silentS === null ? null : this.silentS + (performance.now() - this.batchAt) / 1000;
  }

  open() {
    clearTimeout(this.timer);
    if (this.socket) return;
    const address = new URL('live', document.baseURI);
    address.protocol = address.protocol.replace('http', 'ws');
    address.hash = '';
    const socket = this.socket = new WebSocket(address);
    let opened = false;
    this.batchAt = performance.now();
    socket.onmessage = event => this.take(event.data);
    socket.onopen = () => { opened = true; this.batchAt = performance.now(); this.say(); };
    socket.onclose = async () => {
      if (this.socket !== socket) return;
      this.socket = null;
      const refused = !opened && await refuses();
      if (this.socket) return; // the page was hidden meanwhile, and seen again
      this.enter(refused ? 'refused' : 'closed');
      if (document.hidden) return;
      this.timer = setTimeout(() => this.open(), this.waitMs * (0.5 + Math.random()));
      this.waitMs = Math.min(2 * this.waitMs, LONGEST_WAIT_MS);
    };
  }

  close() {
    clearTimeout(this.timer);
    const socket = this.socket;
    this.socket = null;
    socket?.close();
    this.enter('closed');
  }

  say() {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ topics: [...this.topics] }));
  }

  enter(state) {
    if (this.state === state) return;
    this.state = state;
    this.hand('connection', { state });
  }

  take(text) {
    const batch = JSON.parse(text);
    this.stats.batches += 1;
    this.batchAt = performance.now();
    if (batch.silent_s !== undefined) this.silentS = batch.silent_s; // not in the first one, which says hello
    for (const message of batch.messages) {
      if (message.type === 'touch') this.dataAgeMs = age(batch, message);
      this.last[message.type] = message;
      this.hand(message.type, message);
    }
    this.waitMs = FIRST_WAIT_MS;
    this.enter('open');
    this.hand('batch', batch);
  }

  hand(type, message) {
    for (const handle of this.handlers.get(type) ?? []) handle(message);
  }
}
