"""The overview of many pairs: one HTML page whose table sorts and filters, with a picture of each pair."""

from __future__ import annotations

import re
from collections import Counter
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np

from csgm_ros.batch.results import Row, read
from csgm_ros.errors import CsgmError, InputError
from csgm_ros.io.atomic import write_text
from csgm_ros.types import Similarity

SIZE = (120, 160)  # pixels of a thumbnail
POINTS = 40_000  # of a cloud that are drawn
NUMBERS = ('scale', 'fitness_source', 'fitness_target', 'inlier_rmse', 'margin', 'seconds')
STYLE = """body{font:14px system-ui,sans-serif;margin:1.5em;color:#222}table{border-collapse:collapse}
th,td{padding:.3em .6em;border-bottom:1px solid #ddd;text-align:left;vertical-align:top}
th{cursor:pointer;position:sticky;top:0;background:#fff}td.n{text-align:right;font-variant-numeric:tabular-nums}
.accepted{color:#176d3a}.rejected{color:#9a5b00}.failed{color:#b00020}img{display:block}input{width:24em;padding:.3em}"""
SCRIPT = """const body=document.querySelector('#pairs tbody'),rows=[...body.rows],field=document.querySelector('input');
function filter(){const words=field.value.toLowerCase().split(/\\s+/);let n=0;
for(const r of rows){const shown=words.every(w=>r.textContent.toLowerCase().includes(w));r.hidden=!shown;n+=shown}
document.querySelector('#shown').textContent=n+' of '+rows.length+' pairs'}
field.addEventListener('input',filter);filter();
const value=(r,k)=>{const t=r.cells[k].dataset.v??r.cells[k].textContent,x=parseFloat(t);return isNaN(x)?t:x};
document.querySelectorAll('#pairs th').forEach((th,k)=>th.addEventListener('click',()=>{
const up=th.dataset.up=th.dataset.up==='1'?'0':'1';
rows.sort((a,b)=>{const x=value(a,k),y=value(b,k);
const c=typeof x===typeof y?(x<y?-1:x>y?1:0):typeof x==='number'?-1:1;return up==='1'?c:-c});body.append(...rows)}));"""


def write_report(folder: str | Path, output: str | Path, thumbnails: int = 500) -> str:
    """Write the page and return what it says in a line.

    Parameters
    ----------
    folder : str or Path
        Results of a batch. A page ``reports/KEY.html`` in it is linked; pictures are kept in ``_thumbnails``, so that
        a second report draws only what is new.
    output : str or Path
        An .html to write.
    thumbnails : int, optional
        Pairs that are drawn at most: accepted ones first, then rejected ones.

    Raises
    ------
    InputError
        For a folder without results, or an output that cannot be written.
    """
    folder, output = Path(folder), Path(output)
    rows = read(folder)
    drawn = sorted((row for row in rows if not row['failed']), key=lambda row: not row['accepted'])[:thumbnails]
    try:
        (folder / '_thumbnails').mkdir(exist_ok=True)
        pictures = {row['key'] for row in drawn if _thumbnail(folder, row)}
        write_text(output, _page(folder, output, rows, pictures))
    except OSError as error:
        raise InputError(f'{output}: cannot be written ({error.strerror}); choose another place') from None
    return f'{output}: {len(rows)} pairs, {len(pictures)} of them drawn'


def reason_kind(row: Row) -> str:
    """Return a reason without its numbers and names, so that equal ones can be counted."""
    reason = row['reason'].partition('(')[0]
    reason = re.sub(r'\S*/\S*', 'FILE', reason)
    return re.sub(r'-?\d[\d.e+-]*%?', 'N', reason).strip(' :')


def _kind(row: Row) -> str:
    return 'failed' if row['failed'] else 'accepted' if row['accepted'] else 'rejected'


def _thumbnail(folder: Path, row: Row) -> bool:
    """Draw a pair under its transform unless it is drawn already; False where its clouds can no longer be read."""
    from PIL import Image

    from csgm_ros.io.files import CloudFile, read_points
    from csgm_ros.visual.pictures import SOURCE_TINT, TARGET_TINT, draw, turned, upright

    path = folder / '_thumbnails' / f'{row["key"]}.png'
    if path.exists():
        return True
    transform = Similarity.from_matrix(np.reshape(row['T_target_source'], (4, 4)))
    try:
        source, target = (_some(read_points(row[side], 1_000_000)) for side in ('source', 'target'))
    except CsgmError:
        return False
    clouds = [
        CloudFile(points, np.tile(tint, (len(points), 1)))
        for points, tint in ((target, TARGET_TINT), (transform.apply(source), SOURCE_TINT))
    ]
    pixels = (255 * np.clip(draw(clouds, turned(upright(target), 28, 22), SIZE), 0.0, 1.0)).astype(np.uint8)
    aside = path.with_suffix('.new')
    Image.fromarray(pixels).save(aside, format='png', optimize=True)
    aside.replace(path)
    return True


def _some(points: np.ndarray) -> np.ndarray:
    points = points[np.isfinite(points).all(1)]
    return points[:: -(-len(points) // POINTS)]


def _page(folder: Path, output: Path, rows: list[Row], pictures: set[str]) -> str:
    counts = Counter(map(_kind, rows))
    reasons = Counter((_kind(row), reason_kind(row)) for row in rows)
    summary = ''.join(
        f'<tr><td class="n">{count}</td><td class="{kind}">{kind}</td><td>{escape(reason)}</td></tr>'
        for (kind, reason), count in reasons.most_common()
    )
    said = ', '.join(f'{counts[kind]} {kind}' for kind in ('accepted', 'rejected', 'failed'))
    heads = ''.join(f'<th>{name}</th>' for name in ('', 'pair', 'verdict', *NUMBERS, 'reason'))
    body = '\n'.join(_line(folder, output, row, row['key'] in pictures) for row in rows)
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>csgm batch</title><style>{STYLE}</style></head><body>
<h1>{len(rows)} pairs: {said}</h1>
<table>{summary}</table>
<p><input placeholder="filter: words that a row must hold" aria-label="filter"> <span id="shown"></span></p>
<table id="pairs"><thead><tr>{heads}</tr></thead><tbody>
{body}
</tbody></table><script>{SCRIPT}</script></body></html>
"""


def _line(folder: Path, output: Path, row: Row, drawn: bool) -> str:
    name, kind = escape(row['id']), _kind(row)
    page = folder / 'reports' / f'{row["key"]}.html'
    if page.exists():
        name = f'<a href="{_link(page, output)}">{name}</a>'
    where = _link(folder / '_thumbnails' / f'{row["key"]}.png', output)
    height, width = SIZE
    image = f'<img loading="lazy" width="{width}" height="{height}" alt="" src="{where}">' if drawn else ''
    cells = ''.join(_number(row[column]) for column in NUMBERS)
    return (
        f'<tr><td>{image}</td><td>{name}</td><td class="{kind}">{kind}</td>{cells}<td>{escape(row["reason"])}</td></tr>'
    )


def _number(value: float | None) -> str:
    return '<td class="n"></td>' if value is None else f'<td class="n" data-v="{value!r}">{value:.4g}</td>'


def _link(path: Path, output: Path) -> str:
    """Return a path as the page, wherever it is written, can name it."""
    path, place = path.absolute(), output.absolute().parent
    return quote(str(path.relative_to(place)) if path.is_relative_to(place) else path.as_posix())
