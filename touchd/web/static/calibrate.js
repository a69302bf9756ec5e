// The calibrate view: measures, untouched seconds, fit, verdict, taps, one step at a time. What is shown is the
// wizard's state; a step that is done can be looked at again.
import { element, number, post, say } from './dom.js';
import { measures } from './measures.js';
import { drawing } from './drawing.js';
import { onScreen, stage } from './stage.js';
import { Status } from './status.js';
import { training } from './training.js';
import { trial } from './trial.js';

const UNSEEN_MS = 8000;
const PICTURES = ['response.png', 'residual.png', 'expected-error.png'];

export function mount(root, page) {
  const { texts, feed } = page, t = texts.calibrate;
  const problem = element('p', { class: 'problem', role: 'alert', hidden: true });
  const steps = element('ol', { class: 'steps' }, ...Object.entries(t.steps).map(([name, text]) => 
    element('li', {}, element('button', { type: 'button', 'data-step': name, onclick: () => choose(name) }, text))));
  const button = (text, command, primary = false) =>
    element('button', { type: 'button', ...(primary && { class: 'primary' }), onclick: () => act({ do: command }) }, text);
  const bar = element('progress', { max: 1, value: 0 });
  const share = element('span', { 'aria-hidden': 'true' }), doing = element('p', { class: 'doing', role: 'status' });
  const form = measures(t.measures, async plate => {
    const done = await act({ do: 'measures', plate });
    if (done) choose('untouched');
    return done;
  });
  const drops = element('p', { class: 'muted', hidden: true });
  const listen = button(t.untouched.start, 'untouched', true), stop = button(t.untouched.stop, 'pause');
  const again = button(t.fit.again, 'fit');
  const verdict = element('div', { class: 'fitted' }), begin = button('', 'begin');
  const pane = drawing(t.taps.pane), tapped = element('p', { class: 'tapped', role: 'status' });
  const told = element('p', { class: 'muted' }), most = element('b');
  const scale = element('p', { class: 'scale', hidden: true }, element('b', {}, '0'), element('i'), most), expected = element('p', { class: 'muted' });
  const crosses = element('button', { type: 'button', class: 'primary', onclick: () => showOn('crosses') }, t.screen.start);
  const uncross = button(t.screen.stop, 'pause'), mapped = element('p', { class: 'mapped', role: 'status' });
  const overlay = stage(t.stage, () => { overlay.close(); act({ do: 'pause' }); });
  const tapOn = element('button', { type: 'button', class: 'primary', onclick: () => showOn('taps') }, t.taps.on_screen);
  const tap = button(t.taps.start, 'taps'), pause = button(t.taps.pause, 'pause');
  const undo = button(t.taps.undo, 'undo'), refine = button(t.taps.refine, 'fit');
  const learning = training(t.train, act), inUse = trial(t.trial, act);
  const panel = (name, ...parts) => element('section', { class: 'panel', 'data-panel': name }, element('h2', {}, t.steps[name]), ...parts);
  const busy = element('section', { class: 'panel' }, doing, element('div', { class: 'share' }, bar, share), stop);
  const tapsPanel = panel('taps', element('p', { class: 'muted' }, t.taps.hint), element('div', { class: 'tapping' }, pane.root,
    element('div', {}, tapped, told, expected, scale, element('div', { class: 'row' }, tapOn, tap, pause, undo, refine))));
  const panels = [
    panel('measures', element('p', { class: 'muted' }, t.measures.hint), drops, form.root),
    panel('untouched', element('p', { class: 'muted' }, t.untouched.hint), listen),
    panel('fit', element('p', { class: 'muted' }, t.fit.hint), again),
    busy,
    panel('verdict', verdict),
    panel('screen', element('p', { class: 'muted' }, t.screen.hint), mapped, element('div', { class: 'row' }, crosses, uncross)),
    tapsPanel,
    panel('train', element('p', { class: 'muted' }, t.train.hint), learning.root),
  ];
  root.append(steps, problem, inUse.root, ...panels, overlay.root);
  let shown = '', awaited = '', unseen = false, timer = 0, reached = '', ran = null, refused = false, status = null, chosen = '', staged = '', begun = false;

  async function act(command) {
    const done = await post('calibrate/do', JSON.stringify(command)).catch(() => null);
    const answer = done?.status === 401 ? { problem: texts.no_session } : await done?.json().catch(() => null) ?? { problem: t.failed };
    refuse(!answer.ok && [answer.problem, answer.fix]);
    return answer.ok;
  }

  // Fills the screen with the marks of a job, and begins it unless it runs.
  async function showOn(job) {
    [staged, begun] = [job, false];
    overlay.show('', null, '');
    if (!await overlay.open()) refuse(t.stage.too_small);
    else if (feed.last.calibrate.running === job || await act({ do: job })) update(feed.last.calibrate);
    else overlay.close();
  }

  // Shows what was refused here, until the next command, step or job, else what the wizard says.
  function fault() {
    const { wizard, problem: what, fix } = feed.last.calibrate ?? {};
    const said = wizard === false ? t.no_wizard : refused || [what, fix];
    say(problem, said.filter(Boolean).join(' → ').replaceAll(' -> ', ' → '));
    problem.hidden = !problem.textContent;
  }

  function refuse(said) {
    refused = said;
    fault();
  }

  function choose(step) {
    [chosen, refused] = [step, false];
    refresh();
  }

  function refresh() {
    if (feed.last.calibrate) update(feed.last.calibrate);
  }

  function update(state) {
    for (const each of [inUse.root, ...panels]) each.hidden = true;
    steps.hidden = !state.wizard;
    if (state.running !== ran || (feed.state === 'open' && refused?.[0] === t.failed)) refused = false;
    ran = state.running;
    fault();
    if (!state.wizard) { overlay.close(); return; }
    const { running: job, plate, result } = state, listening = job === 'untouched', fitting = job === 'fit', taught = job === 'train';
    const step = listening ? 'untouched' : fitting ? 'fit' : taught ? 'train' : job === 'taps' ? 'taps' : job === 'crosses' ? 'screen' : result ? 'verdict' : plate ? 'untouched' : 'measures';
    if (step !== reached && !['screen', 'train'].includes(reached)) chosen = step; // what came of these is looked at where it was
    reached = step;
    const open = { measures: true, untouched: plate, fit: state.untouched || fitting, verdict: result && !fitting, screen: (state.runs || state.mapping) && !fitting, taps: result?.model && !fitting, train: true };
    for (const { firstChild: each } of steps.children) {
      if (each.dataset.step === chosen) each.setAttribute('aria-current', 'step');
      else each.removeAttribute('aria-current');
      each.disabled = !open[each.dataset.step];
      each.toggleAttribute('data-now', each.dataset.step === step);
    }
    root.dataset.step = chosen;
    form.show(plate);
    drops.hidden = !result && !state.taps.length;
    say(drops, [result && t.measures.drops_fit, state.taps.length && t.measures.drops(state.taps.length)].filter(Boolean).join(' '));
    for (const each of panels) each.hidden = each.dataset.panel !== chosen;
    busy.hidden = !(listening || fitting || taught);
    tapsPanel.hidden = !open.taps || chosen !== 'verdict' && chosen !== 'taps';
    listen.hidden = again.hidden = listening || fitting || taught;
    say(listen, state.untouched ? t.untouched.again : t.untouched.start);
    bar.value = state.share;
    say(share, `${number(100 * state.share)} ${texts.units.percent}`);
    bar.setAttribute('aria-label', t.steps[step]);
    say(doing, listening ? (state.note === 'finger' ? t.untouched.finger : state.note || t.untouched.running)
      : fitting ? t.fit.running(t.fit.stages[state.note] ?? t.fit.stages.fit)
      : taught ? t.train.running(t.train.stages[state.note] ?? '') : '');
    doing.dataset.level = listening && state.note ? 'warning' : 'ok';
    inUse.show(state);
    if (result) showVerdict(state);
    showScreen(state);
    showTaps(state);
    learning.show(state);
    showMark(state);
  }

  function showScreen({ running, mapping }) {
    const crossing = running === 'crosses', s = t.screen;
    uncross.hidden = !crossing;
    say(crosses, crossing ? s.here : mapping ? s.again : s.start);
    const [x, y, wide, high] = (mapping?.screen_mm ?? []).map(mm => number(mm, 1));
    say(mapped, crossing ? s.elsewhere : !mapping ? s.unknown : s.known(wide, high, x, y, mapping.rotate, mapping.residual_mm && number(mapping.residual_mm, 1)));
  }

  // Shows on the whole screen what the job asks for; without the job, nothing.
  function showMark({ running, cross, target_mm: target, mapping, note }) {
    if (running !== staged) {
      if (begun) overlay.close();
      return;
    }
    begun = true;
    const held = status?.held();
    if (staged === 'crosses') overlay.show('cross', !held && cross?.at, cross ? t.stage.cross(cross.number, cross.of) : '', held || (cross && !cross.at ? t.stage.silent : unseen ? unheard() : ''), 'warning');
    else overlay.show('ring', !held && target && !note && onScreen(target, mapping), t.stage.target, held || tapped.textContent, held ? 'failure' : tapped.dataset.level);
  }

  function showVerdict({ result, runs, compared, taps }) {
    const key = JSON.stringify([result, runs, compared, taps.length > 0]);
    say(begin, t.verdict.begin(taps.length));
    if (key === shown) return;
    const fresh = JSON.stringify(result) !== verdict.dataset.result;
    shown = key;
    verdict.dataset.result = JSON.stringify(result);
    const v = t.verdict, level = { good: 'ok', usable: 'warning', poor: 'failure' }[result.verdict];
    const list = (title, lines) => (lines.length ? [element('h3', {}, title), element('ul', {}, ...lines.map(line => element('li', {}, line)))] : []);
    const pictures = !result.report ? [] : PICTURES.filter(name => result.model || name !== 'expected-error.png').map(name =>
      element('figure', {}, element('img', { src: `calibrate/picture/${name}?${fresh ? Date.now() : ''}`, alt: v.pictures[name], loading: 'lazy' }),
        element('figcaption', {}, v.pictures[name])));
    const row = element('div', { class: 'row' });
    if (result.model && runs !== 'fitted') row.append(button(v.try, 'try', true));
    if (runs) row.append(element('button', { type: 'button', onclick: () => choose('screen') }, t.screen.next));
    if (result.model && taps.length) row.append(button(v.compare, 'compare'));
    row.append(begin);
    const comparison = Object.entries(compared ?? {}).map(([name, one]) =>
      `${v.compared[name]}: ${one.problem ?? v.fits(one.used, one.taps, number(one.scatter_mm, 1), number(100 * one.unexplained, 2))}`);
    verdict.replaceChildren(
      element('p', { class: 'word', 'data-level': level }, v.words[result.verdict]),
      element('p', {}, result.model ? v.expected(number(result.expected_mm, 2)) : v.poor),
      ...list(v.reasons, result.reasons), ...list(v.undecided, result.undecided), row, ...list(v.comparison, comparison),
      element('div', { class: 'pictures' }, ...pictures));
  }

  function showTaps({ running, cross, mapping, plate, taps, last, note, told: known, target_mm: target, expected: heat }) {
    const tapping = running === 'taps';
    tap.hidden = tapping;
    tapOn.hidden = !mapping;
    say(tapOn, tapping ? t.taps.here : t.taps.on_screen);
    tap.classList.toggle('primary', !mapping);
    say(tap, taps.length ? t.taps.resume : t.taps.start);
    pause.hidden = !tapping;
    undo.hidden = refine.hidden = !taps.length;
    pane.root.toggleAttribute('hidden', !tapping && !taps.length); // an SVG has no property `hidden`
    if (plate) pane.show(plate, taps, tapping && !note ? target : null, last, heat);
    scale.hidden = !heat;
    say(expected, heat ? t.taps.expected(number(heat.median_mm, 2), number(heat.fitted_mm, 2), taps.length) : '');
    say(most, heat ? `${number(heat.top_mm, 1)} ${texts.units.mm}` : '');
    awaitTap({ tapping: tapping && !note || cross, taps: taps.length, last, target });
    tapped.dataset.level = unseen || (tapping && note) ? 'warning' : last ? (last.ok ? 'ok' : 'failure') : '';
    const result = last && !unseen ? (last.ok ? `✓ ${t.taps.good}` : `✕ ${t.taps.reasons[last.reason]}`) : '';
    const missing = tapping && (note || (unseen ? unheard() : !last && t.taps.waiting));
    say(tapped, [t.taps.count(taps.length), result, missing].filter(Boolean).join(' · '));
    say(told, known ? [known.repeats ? t.taps.scatter(number(known.scatter_mm, 1), known.repeats) : t.taps.off(number(known.off_mm, 1)), known.orientation && t.taps.turned(known.orientation)].filter(Boolean).join(' ') : '');
  }

  function unheard() {
    return staged === 'crosses' && feed.last.health?.state === 'uncalibrated' ? t.stage.no_model : t.taps.unseen;
  }

  // Notices when no tap comes for some seconds: one that the gate does not see changes nothing in the state.
  function awaitTap(state) {
    const key = JSON.stringify(state);
    if (key === awaited) return;
    awaited = key;
    unseen = false;
    clearTimeout(timer);
    if (state.tapping) timer = setTimeout(() => { unseen = true; refresh(); }, UNSEEN_MS);
  }

  for (const each of [steps, ...panels]) each.hidden = true; // a step chosen before the first state came would be forgotten
  const ends = [feed.on('calibrate', update), feed.on('health', refresh), feed.on('connection', refresh)];
  status = new Status(texts, feed, refresh);
  root.prepend(status.root);
  return () => { clearTimeout(timer); overlay.remove(); status.close(); for (const end of ends) end(); };
}
