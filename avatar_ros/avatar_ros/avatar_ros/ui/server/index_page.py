"""The page that viser serves, with additions that viser does not offer.

Its title; names for screen readers; the colour scheme of the system; text with enough contrast;
keys that move the tool again after a choice; a line over a tab whose cell ended or was restarted;
cube and alerts that stay in place; and none of viser's own settings.
"""

from __future__ import annotations

import gzip
from functools import lru_cache

from websockets import Response

TITLE = "avatar planning page"
ALIVE = "/alive"  # address that answers with the number of the server's start
DIMMED = {"light": "#5a636b", "dark": "#adb5bd"}  # colours of labels beside controls
# colours of buttons, and of the chosen tab on a dark background
BLUE, LIGHT_BLUE = "#1971c2", "#74c0fc"
WARNING = "#b3261e"  # background of alerts, under white text
MOST_SENT = 512 << 20  # largest file that a browser may send [bytes]
RESTARTED = (
    "This cell was started again and has another address. Open the one that planning_ui printed, "
    "which ends in ?token=..."
)
TOO_LARGE = "The file has more than 512 MB: copy it into the library by other means."
SILENT = (
    "Nothing comes from the cell: what this tab shows is old. Start the cell again, and open the "
    "address that it prints; with the same token, this tab comes back by itself."
)
ABOVE_TABS = 362  # height of the panel above a tab's content, with the legend of glass [px]
_THEIRS = b"<title>Viser</title>"
_STYLE = f"""
html:root[data-mantine-color-scheme=light] {{ --mantine-color-gray-6: {DIMMED["light"]};
  --mantine-color-blue-filled: {BLUE}; --mantine-color-blue-outline: {BLUE} }}
html:root[data-mantine-color-scheme=dark] {{ --mantine-color-dark-2: {DIMMED["dark"]} }}
[data-mantine-color-scheme=dark] [role=tab][aria-selected=true] {{ color: {LIGHT_BLUE} !important }}
[role=tab] {{ padding: 0 0.6em !important }}
@media (min-width: 36em) {{  /* what is above the tabs stays in view: only a tab scrolls */
  .mantine-ScrollArea-root .mantine-ScrollArea-root .mantine-ScrollArea-viewport {{
    max-height: max(12em, calc(100vh - {ABOVE_TABS}px)) }}
}}
/* A panel that glides, as when the window changes, would take along and cut what is fixed in it. */
[data-dock-column] {{ transform: none !important; transition: none !important }}
button:has(.tabler-icon-adjustments) {{ display: none }}  /* viser's settings, of no use here */
.mantine-Notifications-root {{ inset: auto auto 90px 14px !important }}  /* alerts are above */
#restarted {{ position: fixed; inset: 0 0 auto 0; z-index: 9; padding: 12px 16px; color: #fff;
  background: {WARNING}; font: 600 16px sans-serif }}
"""
_SCRIPT = """
const scheme = matchMedia('(prefers-color-scheme: dark)');
window.__VISER_EMBED_CONFIG__ = {darkMode: scheme.matches};
scheme.addEventListener('change', () => location.reload());

// A list or box that was clicked gives the keys back to the tool.
document.addEventListener('click', event => {
  if (event.target.closest('[role=option], input[type=checkbox]')) document.activeElement.blur();
});

function nameOf(element) {
  if (element.querySelector('.tabler-icon-list-search')) return 'Commands';
  if (element.tagName == 'CANVAS' && !element.closest('.mantine-ScrollArea-root'))
    return 'Organ and tools in three dimensions; the panel says the numbers in words';
  for (let around = element.parentElement; around; around = around.parentElement) {
    const text = around.querySelector('label, .u-title')?.innerText;
    if (text) return text;
  }
  return '';
}
const NAMED = 'button, canvas, input:not([type=hidden]), [role=slider]';
function nameAll() {
  for (const e of document.querySelectorAll(NAMED)) {
    if (!e.checkVisibility() || e.ariaHidden == 'true') continue;
    if (e.ariaLabel || e.innerText || e.labels?.length) continue;
    e.ariaLabel = nameOf(e);
    if (e.tagName == 'CANVAS') e.role = 'img';
  }
}
setInterval(nameAll, 1000);

document.addEventListener('change', event => {
  if (!(event.target.files?.[0]?.size > MOST_SENT)) return;
  event.stopImmediatePropagation();
  alert('TOO_LARGE');
}, true);

let start = null, failures = 0;
function warn(text) {
  const line = document.getElementById('restarted') ?? document.body.appendChild(
    Object.assign(document.createElement('div'), {id: 'restarted', role: 'alert'}));
  if (line.innerText != text) line.innerText = text;
  line.hidden = !text;
}
async function ask() {
  try {
    const answer = await fetch('ALIVE', {signal: AbortSignal.timeout(5000)});
    failures = 0;
    if (!answer.ok) return warn('RESTARTED');
    const number = await answer.text();
    if (start !== null && start != number) location.reload();
    start = number;
    warn('');
  } catch {
    if (++failures > 1) warn('SILENT');
  }
}
setInterval(ask, 2000);
"""


def complete(response: Response) -> None:
    """Put all of this into a response, if it is the page."""
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return
    is_packed = response.headers.get("Content-Encoding") == "gzip"
    response.body = _completed(bytes(response.body), is_packed)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


@lru_cache(maxsize=2)
def _completed(body: bytes, is_packed: bool) -> bytes:
    script = _SCRIPT
    texts = {"ALIVE": ALIVE, "RESTARTED": RESTARTED, "SILENT": SILENT, "TOO_LARGE": TOO_LARGE}
    for name, value in texts.items():
        script = script.replace(f"'{name}'", f"'{value}'")
    script = script.replace("MOST_SENT", str(MOST_SENT))
    ours = f"<title>{TITLE}</title><style>{_STYLE}</style><script>(() => {{{script}}})()</script>"
    whole = gzip.decompress(body) if is_packed else body
    whole = whole.replace(_THEIRS, ours.encode(), 1)
    return gzip.compress(whole) if is_packed else whole
