// The check view: the doctor's examination, line by line with what to do, and the support bundle.
import { element, post, say } from './dom.js';
import { Status } from './status.js';

export function mount(root, page) {
  const { texts, feed } = page, t = texts.check;
  const status = new Status(texts, feed);
  const start = element('button', { type: 'button', class: 'primary', onclick: examine }, t.start);
  const hint = element('p', { class: 'muted' }, t.hint), verdict = element('p', { class: 'verdict', role: 'status' });
  const list = element('ol', { class: 'findings', 'aria-label': t.title });
  const wish = element('input', { type: 'checkbox', id: 'recording' });
  const fetching = element('button', { type: 'button', onclick: download }, t.bundle.button);
  const answer = element('p', { class: 'muted', role: 'status' });
  root.append(
    status.root,
    element('section', { class: 'panel' }, element('h2', {}, t.title), hint, element('div', { class: 'row' }, start, verdict), list),
    element('section', { class: 'panel' }, element('h2', {}, t.bundle.title), element('p', { class: 'muted' }, t.bundle.hint),
      element('label', { class: 'choice', for: 'recording' }, wish, t.bundle.recording), element('div', { class: 'row' }, fetching, answer)));

  async function examine() {
    start.disabled = true;
    const done = await post('check/start').catch(() => null);
    if (!done?.ok && done?.status !== 409) {
      start.disabled = false;
      say(verdict, done?.status === 401 ? texts.no_session : t.failed);
    }
  }

  async function download() {
    fetching.disabled = true;
    say(answer, wish.checked ? t.bundle.recording_now : t.bundle.making);
    const done = await post('check/bundle', wish.checked ? 'recording' : '').catch(() => null);
    fetching.disabled = false;
    if (!done?.ok) { say(answer, done?.status === 401 ? texts.no_session : t.failed); return; }
    const link = element('a', { href: URL.createObjectURL(await done.blob()), download: 'touchd-support.zip' });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
    say(answer, t.bundle.done);
  }

  function row({ check, level, text, fix }) {
    const name = element('span', { class: 'name' }, check);
    const said = element('div', { class: 'text' }, text);
    if (fix) said.append(element('p', { class: 'fix' }, element('b', {}, `${t.fix} `), fix));
    return element('li', { 'data-level': level }, element('span', { class: 'level' }, t.levels[level] ?? level), name, said);
  }

  const end = feed.on('check', ({ running, findings, problem }) => {
    start.disabled = running;
    say(start, running ? t.running : findings.length ? t.again : t.start);
    list.replaceChildren(...findings.map(row));
    const count = level => findings.filter(finding => finding.level === level).length;
    verdict.dataset.level = count('failure') || problem ? 'failure' : count('warning') ? 'warning' : 'ok';
    say(verdict, problem || (running ? t.progress(findings.length) : t.verdict(findings.length, count('failure'), count('warning'))));
  });
  // Another server knows nothing of the examination; this one says again that it runs.
  const lost = feed.on('connection', ({ state }) => {
    if (state !== 'closed' || !start.disabled) return;
    start.disabled = false;
    say(start, t.again);
    say(verdict, '');
  });
  return () => { end(); lost(); status.close(); };
}
