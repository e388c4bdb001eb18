"""The style sheet of report.html: light and dark, screen and paper, no font or picture from outside."""

STYLE = """
:root { color-scheme: light dark; --ink: #1d232b; --soft: #667281; --line: #dfe4ea; --page: #f6f7f9;
  --card: #ffffff; --accent: #2563b8; --alert: #9a5b00; --alert-card: #fff6e5; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ee; --soft: #98a3b1; --line: #333b46;
  --page: #14181d; --card: #1c2128; --accent: #6ea8f0; --alert: #f0b95c; --alert-card: #2c2415; }
  img.plot { filter: invert(0.89) hue-rotate(180deg); }
  img.map { filter: brightness(0.88); } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI",
  "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1040px; margin: 0 auto; padding: 28px 20px 60px; }
h1 { font-size: 26px; line-height: 1.25; margin: 0 0 18px; overflow-wrap: anywhere; }
h1 small { display: block; font-size: 13px; font-weight: 500; color: var(--soft); letter-spacing: 0.04em; }
h2 { font-size: 17px; margin: 0 0 10px; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 16px 20px;
  margin: 16px 0; min-width: 0; }
section.warnings { background: var(--alert-card); border-color: var(--alert); }
section.warnings h2 { color: var(--alert); }
section.warnings ul { margin: 0; padding-left: 20px; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(170px, 1fr)); margin: 0;
  background: var(--card); border: 1px solid var(--line); border-radius: 10px; overflow: hidden; }
.facts div { outline: 1px solid var(--line); padding: 10px 16px; }
.facts dt { color: var(--soft); font-size: 13px; }
.facts dd { margin: 0; font-size: 19px; font-weight: 600; font-variant-numeric: tabular-nums; }
.columns { display: grid; grid-template-columns: repeat(auto-fit, minmax(320px, 1fr)); gap: 0 16px; }
.layers { display: grid; grid-template-columns: repeat(auto-fit, minmax(220px, 1fr)); gap: 16px;
  margin-top: 12px; }
figure { margin: 0; }
figcaption { color: var(--soft); font-size: 13px; margin-top: 4px; }
img { display: block; max-width: 100%; height: auto; margin: 0 auto; border-radius: 6px; }
p { margin: 0 0 10px; }
table { border-collapse: collapse; margin: 0 0 12px; font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 500; color: var(--soft); }
th, td { padding: 3px 18px 3px 0; border-bottom: 1px solid var(--line); vertical-align: top;
  overflow-wrap: anywhere; }
table.numbers { font-size: 13px; }
table.numbers th:nth-child(-n+5), table.numbers td:nth-child(-n+5), td + td:not(.bar):last-child {
  white-space: nowrap; }
table.notes th:first-child, table.notes td:first-child { white-space: nowrap; }
table.notes td + td:not(.bar):last-child { white-space: normal; }
table.bars { width: 100%; }
td.bar { width: 50%; padding-right: 0; vertical-align: middle; }
td.bar i { display: block; height: 8px; min-width: 1px; border-radius: 4px; background: var(--accent); }
summary { cursor: pointer; color: var(--accent); padding: 2px 0; }
details[open] summary { margin-bottom: 8px; }
pre { margin: 0; overflow-x: auto; font: 13px/1.45 ui-monospace, Menlo, Consolas, monospace; }
@media print { body { background: none; font-size: 11pt; } main { max-width: none; padding: 0; }
  section { break-inside: avoid; border: 0; padding: 0; } img { max-height: 60vh; } }
"""
