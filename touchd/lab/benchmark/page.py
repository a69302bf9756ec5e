"""A run as the page docs/benchmarks.md."""

from __future__ import annotations

from touchd.config.schema import RealtimeSettings
from touchd.lab.benchmark import tables
from touchd.lab.benchmark.results import Run
from touchd.lab.benchmark.tables import Table

WIDTH = "---"


def page(run: Run, pictures: str) -> str:
    """Return the page of a run; its pictures are in a folder of that name beside it."""
    t = run.touches
    parts = [
        "# Benchmarks",
        f"<!-- Written by touchd benchmark, version {run.machine.touchd}: do not edit. -->",
        "Made by `touchd benchmark --docs docs`"
        + (" with --quick" if run.quick else "")
        + f" in {run.seconds:.0f} s on: {run.machine.line()}. The figures as they are stored: "
        "[benchmarks.json](benchmarks.json); `touchd benchmark --compare docs/benchmarks.json` compares another run, "
        "on any computer, by its ratios to the bare network.",
        "Times of a shared computer mean little by themselves. So everything takes turns with *the bare network*, in "
        "the same process: one run of the source paper's regression network (Bahrami et al., Sensors 22:3183, 2022: "
        "392-400-300-200-100-2, 357,000 multiply-adds) with random weights, since what it costs does not depend on "
        "them. Its error, trained by the paper's recipe, is in "
        "[reproduction.md](reproduction.md#regression-and-grids). `x bare` is the median, over the turns, of the ratio "
        "to it. The paper gives 0.44 ms for its regression and 0.28 ms for its keypad, on a computer of its own.",
        "## Budgets",
        "Those that one run can tell. A frame at full speed is timed from the moment it is there to that at which its "
        "message is with the socket, or to the decision that there is none.",
        _markdown(tables.budget_table(run)),
        "## Run time against error",
        f"{t.count} touches of a {t.finger} finger, simulated with seed {t.seed}, which no training saw, anywhere on "
        "the plate but for 5 mm at its edge; noise 60 dB below the signal, temperature walking within +-1 K and the "
        "baseline with it. Every estimator gets the same residuals, one by one, and its time goes from the residual to "
        "the position, features included."
        + (
            f" No unbiased estimate can have a median error below {t.bound_mm:.4f} mm (Cramer-Rao)."
            if t.bound_mm is not None
            else ""
        ),
        f"![Error against run time]({pictures}/errors.png)",
        _markdown(tables.estimator_table(run)),
        _estimator_notes(run),
        "## The daemon, end to end",
        "A daemon in a process of its own with all that it has in service (bus, health, pre-roll), and a subscriber in "
        "another"
        + (": at a steady rate both on one processor, at full speed each on its own" if run.apart else "")
        + ". Scenes of a human finger are computed by the digital twin beforehand, at 125 frames a second, and "
        "played to and fro: at 1,000 the finger is eight times as quick. Times go from a frame complete on the "
        "computer to its event decoded by the subscriber (of a still finger only ten frames a second have a message); "
        "where nothing is sent (idle), to the decision; at full speed, where messages queue up, to the socket, and "
        "shown is the run of median ratio out of three. "
        "`handed` is to the socket, or to the decision, in all of them, and `x bare` its ratio to the bare network in "
        "that process. At full speed the bus's thread sends when the frames leave it time to (SCHED_BATCH). "
        "Frames at a steady rate find the processor's caches cold and its clock low; those at full speed "
        "do not. `frames/CPU s` is how many frames a second of processor time is enough for, that of the bus's own "
        "thread included.",
    ]
    if any(cell.rate_hz for cell in run.daemon):
        parts.append(f"![The daemon's latency]({pictures}/latency.png)")
    parts += [_markdown(tables.daemon_table(run)), _daemon_notes(run)]
    parts += [
        _markdown(tables.share_table(run)),
        "## What each skip saves",
        "The same frames through two pipelines in turns, one with the skip and one without (`[skip]` in the "
        "[configuration](configuration.md)): median time of a frame in the pipeline. `tracking` compares the "
        "estimators above: a finger that is followed needs no network. `bins` compares the product that makes the "
        "features, with the bins that the atlas keeps and with all of the chirp's band; the error that this costs is "
        "measured in training.",
        _markdown(tables.skip_table(run)),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _estimator_notes(run: Run) -> str:
    lines = [f"- `{one.name}`: {one.remark}." for one in run.estimators if one.remark]
    lines += [
        "- `floor`: the time to read the estimator's weights, tables or recorded touches (kB) once from the cache that "
        "they fit in, measured as a product of a buffer of that size with itself. `MACs` are multiply-adds, at most.",
        "- What the atlas does once a second, to see how warm the untouched plate is and what its gains are, is in the "
        "daemon's times and not in these.",
        "- `missed`: touches in which no finger was found in that frame; for some a search of the atlas goes on in the "
        "next ones. The errors are of the others.",
        "- Percentiles are of the calls after the burn-in, "
        + f"{min(one.calls for one in run.estimators):,} to {max(one.calls for one in run.estimators):,} each.",
    ]
    lines += [f"- Left out: {what}." for what in run.left_out]
    return "\n".join(lines)


def _daemon_notes(run: Run) -> str:
    lines = []
    if run.day is not None:
        d = run.day
        lines.append(
            f"- A typical day ({d.idle:.0%} idle, {d.still:.0%} a still finger, {d.moving:.0%} a moving one, 125 "
            f"frames a second) costs **{d.cpu_s_per_hour:.0f} s of processor time an hour**."
        )
    if run.bus_us is not None:
        b = run.bus_us
        lines.append(
            f"- The bus with nothing behind it, from process to process at 1,000 messages a second, in turns with the "
            f"moving finger at 1,000 frames/s: p50 {b.p50:,.0f}, p99 {b.p99:,.0f}, p99.9 {b.p999:,.0f} us. So much of "
            "the times to the subscriber is ZeroMQ's, the kernel's and this computer's; of either the run of median "
            "99.9th percentile out of three is shown."
        )
    if run.held_up_us is not None:
        h = run.held_up_us
        lines.append(
            "- A program on that processor that never sleeps and does nothing but look at the clock sees each "
            f"thousandth of a second p50 {h.p50:,.2f}, p99 {h.p99:,.2f}, p99.9 {h.p999:,.0f} us late: for so long this "
            "computer, or the host of a virtual one, holds up whatever runs on it."
        )
    if run.apart is not None:
        whole, alone = run.apart.daemon_us, run.apart.bus_us
        lines.append(
            f"- With the subscriber on another processor than the daemon: p50 {whole.p50:,.0f}, p99 {whole.p99:,.0f}, "
            f"p99.9 {whole.p999:,.0f} us"
            + (
                f", and the bus with nothing behind it {alone.p50:,.0f}, {alone.p99:,.0f} and {alone.p999:,.0f} us"
                if alone is not None
                else ""
            )
            + "."
        )
    if run.asleep is not None:
        whole = run.asleep.daemon_us
        lines.append(
            f"- From {RealtimeSettings().awake_from_hz:g} frames a second on the processors are kept awake while a "
            "finger is on the plate "
            f"(`realtime.awake_from_hz`). Where they may sleep, that finger takes p50 {whole.p50:,.0f}, p99 "
            f"{whole.p99:,.0f}, p99.9 {whole.p999:,.0f} us to the subscriber."
        )
    cells = run.daemon
    if cells:
        lines.append(
            f"- Resident memory: {min(c.rss_mb for c in cells):.0f} to {max(c.rss_mb for c in cells):.0f} MB, the "
            "benchmark's own arrays included."
        )
        lines.append(
            f"- Garbage collection: {sum(c.gc_pauses for c in cells)} pauses in all, the longest "
            f"{max(c.gc_longest_us for c in cells):.0f} us."
        )
        few = [c for c in cells if c.frames < 1000]
        if few:
            lines.append("- Where fewer than 1,000 frames were counted, the 99.9th percentile is nearly the maximum.")
    return "\n".join(lines)


def _markdown(table: Table) -> str:
    """Return a Markdown table: names to the left, numbers to the right."""
    if not table.rows:
        return ""
    text = {i for i in range(len(table.headings)) if any(not _is_number(row[i]) for row in table.rows)}
    rule = "|" + "|".join(WIDTH if i in text else WIDTH + ":" for i in range(len(table.headings))) + "|"
    lines = ["| " + " | ".join(table.headings) + " |", rule]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in table.rows])


def _is_number(text: str) -> bool:
    return text == "-" or text.replace(",", "").rstrip("%").replace("+", "-").lstrip("-").replace(".", "", 1).isdigit()
