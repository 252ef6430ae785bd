"""The report's style sheet."""

STYLE = """
:root {
  color-scheme: light dark;
  --page: #fafaf8; --panel: #ffffff; --ink: #1c2328; --soft: #5b666e; --line: #e2e5e6; --faint: #eef0f0;
  --accent: #1f6a85; --accent-soft: #9cc3d1; --warn: #a4560f; --warn-soft: #fbf2e6;
  --ramp0: #e4eff2; --ramp1: #0d4b63; --stage: #14191d;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #14171a; --panel: #1b1f23; --ink: #e3e7e9; --soft: #98a3aa; --line: #2f363b; --faint: #242a2e;
    --accent: #7db8cd; --accent-soft: #38606f; --warn: #e2a15c; --warn-soft: #2b2419;
    --ramp0: #22323a; --ramp1: #a9dcec; --stage: #0d1012;
  }
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body {
  margin: 0; background: var(--page); color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", "Noto Sans", sans-serif;
}
main { max-width: 1240px; margin: 0 auto; padding: 36px 28px 56px; }
h1 { font-size: 27px; line-height: 1.2; font-weight: 600; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 17px; font-weight: 600; margin: 0 0 4px; }
h3 { font-size: 14px; font-weight: 600; margin: 0 0 6px; }
p { margin: 0 0 8px; }
.lead, .soft { color: var(--soft); }
.lead { font-size: 16px; margin: 6px 0 0; max-width: 78ch; }
.soft { font-size: 13.5px; max-width: 92ch; }
section { margin-top: 36px; }
.two { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 36px 32px; margin-top: 36px; }
.two > section { margin-top: 0; }
.three { display: grid; grid-template-columns: repeat(3, minmax(0, 1fr)); gap: 16px; margin-top: 12px; }
.panel { background: var(--panel); border: 1px solid var(--line); border-radius: 6px; padding: 14px; }
@media (max-width: 940px) {
  .two, .three { grid-template-columns: minmax(0, 1fr); }
  main { padding: 24px 16px; }
}

.numbers { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); margin: 26px 0 0;
  border-top: 1px solid var(--line); border-bottom: 1px solid var(--line); }
.numbers div { padding: 12px 16px 12px 0; display: flex; flex-direction: column; justify-content: end; }
.numbers dt { font-size: 13px; color: var(--soft); }
.numbers dd { margin: 0; font-size: 23px; line-height: 1.25; font-variant-numeric: tabular-nums;
  white-space: nowrap; }
.numbers small { font-size: 14px; color: var(--soft); }

.notes { list-style: none; margin: 8px 0 0; padding: 0; max-width: 96ch; }
.notes li { padding: 5px 0 5px 15px; border-left: 3px solid var(--line); margin-bottom: 5px; }
.notes li.warn { border-color: var(--warn); background: var(--warn-soft); }

.stage { position: relative; margin-top: 10px; background: var(--stage); border-radius: 6px;
  overflow: hidden; }
.stage canvas { display: block; width: 100%; height: min(600px, 70vh); cursor: grab; touch-action: none;
  outline: none; }
.stage canvas:active { cursor: grabbing; }
.stage:fullscreen canvas { height: 100vh; }
.tools { position: absolute; top: 10px; right: 10px; display: flex; flex-wrap: wrap; gap: 8px 14px;
  align-items: center; justify-content: flex-end; color: #c9d1d5; font-size: 13px; padding-left: 10px; }
.tools label { display: flex; gap: 6px; align-items: center; }
.tools input[type=range] { width: 80px; accent-color: #7db8cd; }
.tools input[type=checkbox] { accent-color: #7db8cd; margin: 0; }
.tools button { font: inherit; color: inherit; background: #ffffff14; border: 1px solid #ffffff26;
  border-radius: 4px; padding: 2px 9px; cursor: pointer; }
.tools button:hover { background: #ffffff2b; }
.empty { border: 1px dashed var(--line); border-radius: 6px; padding: 30px; color: var(--soft);
  text-align: center;
  margin-top: 10px; }

svg { display: block; width: 100%; height: auto; }
svg text { font-family: inherit; fill: var(--ink); }
.bar { fill: var(--accent); }
rect.bar:hover { fill: var(--warn); }
.grid { stroke: var(--faint); fill: none; }
.axis { stroke: var(--soft); stroke-width: 1; fill: none; }
svg .tick { font-size: 11.5px; fill: var(--soft); font-variant-numeric: tabular-nums; }
svg .label, svg .stage-name { font-size: 12.5px; fill: var(--soft); }
svg .stage-name { font-size: 13px; fill: var(--ink); }
.mark { stroke: var(--warn); stroke-dasharray: 3 3; fill: none; }
svg .mark-text { font-size: 11.5px; fill: var(--warn); }
.density { fill: var(--soft); opacity: 0.75; }
.sequence { fill: none; stroke: var(--accent); stroke-opacity: 0.45; stroke-width: 1; }
.cam path { fill: var(--accent); fill-opacity: 0.28; stroke: var(--accent); stroke-width: 0.8; }
.cam circle { fill: var(--accent); stroke: var(--panel); stroke-width: 0.8; }
.cam:hover path, .cam:hover circle { fill: var(--warn); stroke: var(--warn); fill-opacity: 0.9; }
figure { margin: 10px 0 0; }
.timings { max-width: 760px; }

.matrix canvas { display: block; width: 100%; aspect-ratio: 1; }
.ramp { display: flex; align-items: center; gap: 8px; margin-top: 8px; color: var(--soft);
  font-size: 12.5px; }
.ramp i { flex: 0 0 150px; height: 10px; border-radius: 2px;
  background: linear-gradient(90deg, var(--ramp0), var(--ramp1)); }
.ramp b { flex: 0 0 4px; height: 12px; background: var(--warn); margin-left: 14px; }

.scroll { overflow-x: auto; margin-top: 10px; }
table { border-collapse: collapse; width: 100%; font-size: 14px; }
th, td { text-align: left; padding: 7px 12px 7px 0; border-bottom: 1px solid var(--line);
  vertical-align: middle; }
thead th { font-weight: 500; white-space: nowrap; padding-bottom: 5px; border-bottom-color: var(--soft); }
thead th[data-sort=number], .num { text-align: right; }
.num { font-variant-numeric: tabular-nums; white-space: nowrap; }
th button { all: unset; cursor: pointer; color: var(--soft); }
th button:hover, th[aria-sort] button { color: var(--ink); }
th button:focus-visible, .zoom:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
th[aria-sort=ascending] button::after { content: " \\2191"; }
th[aria-sort=descending] button::after { content: " \\2193"; }
.name { font-weight: 500; overflow-wrap: anywhere; unicode-bidi: isolate; min-width: 20ch; }
th:last-child, td.state { padding-left: 16px; }
td.state { color: var(--soft); min-width: 24ch; }
tr.absent td.state { color: var(--warn); }
.thumb { width: 152px; padding-right: 16px; }
.zoom { all: unset; display: block; width: 136px; cursor: zoom-in; }
.zoom svg, dialog svg { border-radius: 3px; }
.halo, .dots { fill: none; stroke-linecap: round; }
.halo { stroke: #000000a0; stroke-width: 5.5px; }
.dots { stroke: #ffd34d; stroke-width: 3.6px; }
dialog { border: 0; padding: 0; background: var(--panel); color: var(--ink); width: min(92vw, 1100px);
  border-radius: 6px; }
dialog p { margin: 0; padding: 8px 14px; overflow-wrap: anywhere; }
dialog svg { max-height: 84vh; }
dialog .halo { stroke-width: 2.6px; } dialog .dots { stroke-width: 1.5px; }
dialog::backdrop { background: #000000b0; }

details { margin-top: 10px; }
summary { cursor: pointer; color: var(--soft); }
.settings { max-width: 760px; font-size: 13.5px; }
.settings th { font-weight: 400; color: var(--soft); }
.settings td { font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.cameras { margin: 8px 0 0; padding: 0; list-style: none; font-variant-numeric: tabular-nums;
  overflow-wrap: anywhere; }
.cameras li { padding: 4px 0; border-bottom: 1px solid var(--line); }
footer { margin-top: 44px; padding-top: 12px; border-top: 1px solid var(--line); color: var(--soft);
  font-size: 13px; }
#tip { position: fixed; z-index: 9; pointer-events: none; max-width: 340px; padding: 5px 9px;
  border-radius: 4px;
  background: #0b0e10f0; color: #eef2f4; font-size: 13px; line-height: 1.4; white-space: pre-line;
  overflow-wrap: anywhere; }
"""
