// The live view: the plate, the state that is legible across a room, and what the daemon says of itself.
import { element, say } from './dom.js';
import { PlateView } from './plate.js';
import { Status } from './status.js';
import { Fingers, Figures, Budget, LatencyChart, Noise, Spectrum } from './panels.js';

export function mount(root, page) {
  const { texts, feed } = page;
  const plate = new PlateView(texts), fingers = new Fingers(texts);
  const panels = [fingers, new Figures(texts), new Budget(texts), new Noise(texts), new LatencyChart(texts),
    new Spectrum(texts, feed)];
  const footer = element('span'), age = element('span');
  const side = element('div', { class: 'side', tabindex: 0, role: 'region', 'aria-label': texts.figures.title },
    element('div', { class: 'panels' }, ...panels.map(panel => panel.root)), element('div', { class: 'footer' }, footer, age));
  root.append(plate.root, side);
  const hidden = () => page.hello.shows_keys === false && (feed.last.plate?.keys.length ?? 0) > 0;
  // The truth is about now, or nobody knows it.
  const forget = () => { delete feed.last.truth; plate.set('truth', []); };
  const ends = [
    feed.on('hello', hello => plate.set('screen', hello.screen_mm)),
    feed.on('calibrate', ({ mapping }) => mapping && plate.set('screen', mapping.screen_mm)),
    feed.on('plate', message => {
      plate.set('plate', message);
      say(fingers.none, hidden() ? texts.keypad_hidden : texts.fingers.none);
    }),
    feed.on('touch', message => {
      plate.setContacts(message.contacts);
      if (!message.contacts.length) forget(); // the daemon is silent
    }),
    feed.on('truth', message => plate.set('truth', message.contacts_mm)),
    feed.on('history', message => { for (const health of message.health) for (const panel of panels) panel.past?.(health); }),
    ...['plate', 'touch', 'truth', 'health', 'spectrum'].map(type =>
      feed.on(type, message => { for (const panel of panels) panel[type]?.(message); })),
    feed.on('health', message => {
      say(footer, texts.footer(message.version, message.model, feed.last.plate?.source));
      if (message.state === 'streaming') return;
      plate.setContacts([]);
      forget();
    }),
    feed.on('batch', () => say(age, feed.dataAgeMs !== null ? texts.age(Math.round(feed.dataAgeMs)) : '')),
  ];
  const status = new Status(texts, feed, stale => {
    plate.set('stale', stale);
    if (stale) { forget(); plate.clear(); } // nobody knows where the fingers are
    root.classList.toggle('stale', stale);
  });
  root.prepend(status.root);
  return () => {
    for (const end of ends) end();
    plate.close();
    status.close();
    for (const panel of panels) panel.close?.();
  };
}
