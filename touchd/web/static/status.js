// What the daemon's state is, in letters for two metres. Silence is a state.
import { element, say } from './dom.js';

const LATE_MS = 1000;
// Of a reason over 90 letters, which would leave no place for the plate, the part that is said as large as a short one.
const FIRST = /^.{1,89}?;(?= )|^.{1,90}?(?= -> )|^.{1,90}(?= )/, LONG = 90;
const SILENT_S = 3; // health comes each second
const LEVELS = { streaming: 'ok', starting: 'busy', uncalibrated: 'warning', stalled: 'failure', lost: 'failure', stopping: 'failure' };

export class Status {
  // `onStale` is called with whether what is shown is old, each time that changes.
  constructor(texts, feed, onStale = () => {}) {
    this.texts = texts;
    this.feed = feed;
    this.word = element('strong', { class: 'state-word' });
    this.first = document.createTextNode('');
    this.more = element('span', { class: 'more' });
    this.reason = element('span', { class: 'state-reason' }, this.first, this.more);
    this.root = element('div', { class: 'state', role: 'status' }, this.word, this.reason);
    this.onStale = onStale;
    this.stale = null;
    this.ends = ['connection', 'health', 'batch'].map(type => feed.on(type, () => this.update()));
    this.timer = setInterval(() => this.update(), 500);
    this.update();
  }

  // What keeps frames from coming; empty while they come.
  held() {
    const { level, word, reason } = this.now();
    return ['failure', 'busy'].includes(level) ? `${word}: ${reason}` : '';
  }

  close() {
    clearInterval(this.timer);
    for (const end of this.ends) end();
  }

  update() {
    const { level, word, reason, stale } = this.now();
    this.root.dataset.level = level;
    say(this.word, word);
    const first = reason.length > LONG ? (FIRST.exec(reason)?.[0] ?? reason) : reason;
    say(this.first, first);
    say(this.more, reason.slice(first.length));
    if (stale === this.stale) return;
    this.stale = stale;
    this.onStale(stale);
  }

  now() {
    const { texts, feed } = this, health = feed.last.health, silent = feed.silence();
    const state = (level, [word, reason], stale = true) => ({ level, word, reason, stale });
    if (feed.state === 'connecting') return state('busy', texts.connecting);
    if (feed.state === 'refused') return state('failure', texts.no_access);
    if (feed.state !== 'open') return state('failure', texts.no_server);
    if (silent === null || !health) return state('failure', texts.no_daemon);
    if (health.state === 'stopping') return state('failure', texts.states.stopping);
    if (silent > SILENT_S) return state('failure', texts.silent(Math.floor(silent)));
    const [word, meaning] = texts.states[health.state] ?? [health.state, ''];
    if (feed.dataAgeMs > LATE_MS && feed.last.touch?.contacts.some(one => one.phase !== 'up')) return state('warning', texts.late((feed.dataAgeMs / 1000).toFixed(1)), false);
    const level = health.state === 'streaming' && health.reason ? 'warning' : LEVELS[health.state] ?? 'warning';
    return state(level, [word, health.reason ?? meaning], false);
  }
}
