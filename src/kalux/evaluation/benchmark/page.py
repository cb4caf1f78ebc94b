"""Style and script of the report: one page for light and dark, wide and narrow, that asks for nothing from outside."""

from __future__ import annotations

from typing import Final

STYLE: Final = """
:root{color-scheme:light dark;--page:#fff;--ink:#1c2126;--soft:#56606b;--rule:#d5dae0;--shade:#f4f6f8;--best:#e3efe6;
--focus:#0b63c4;--s0:#6b7280;--s1:#9a6700;--s2:#0072b2;--s3:#ad1f86;--s4:#bf3a2b;--s5:#0a6e45;--s6:#5a3fcf;--s7:#333}
@media(prefers-color-scheme:dark){:root{--page:#14181c;--ink:#e6e9ec;--soft:#a3adb8;--rule:#39424c;--shade:#1d2329;
--best:#1f3a2b;--focus:#7cb8ff;--s0:#a5adb8;--s1:#e2ab3a;--s2:#5db9f2;--s3:#ee86d6;--s4:#ff8674;--s5:#45cf93;
--s6:#b09eff;--s7:#ddd}}
*{box-sizing:border-box}
html{scroll-behavior:smooth}
body{margin:0;background:var(--page);color:var(--ink);
font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif}
main,header{max-width:1180px;margin:0 auto;padding:0 20px}
header{padding-top:36px}
h1{font-size:1.75rem;line-height:1.25;margin:0 0 .4rem;text-wrap:balance}
h2{font-size:1.3rem;margin:3.2rem 0 .6rem;padding-top:.9rem;border-top:1px solid var(--rule)}
h3{font-size:1.02rem;margin:1.9rem 0 .5rem}
p{max-width:75ch;margin:.5rem 0}
.soft,figcaption{color:var(--soft);font-size:.875rem}
a{color:var(--focus)}
nav{margin:1rem 0 0;font-size:.95rem}
nav a{display:inline-block;margin-right:1.1rem}
code{font:.9em ui-monospace,SFMono-Regular,Menlo,Consolas,monospace;overflow-wrap:anywhere}
.wide{overflow-x:auto;margin:.8rem 0}
table{border-collapse:collapse;font-size:.9rem;font-variant-numeric:tabular-nums}
th,td{padding:.28rem .7rem;text-align:right;white-space:nowrap}
th{font-weight:600}
thead th{border-bottom:1px solid var(--ink);vertical-align:bottom}
th[scope=row],th.corner{text-align:left;font-weight:400;position:sticky;left:0;background:var(--page);z-index:1}
thead th.group{text-align:center;border-bottom:1px solid var(--rule)}
tbody+tbody th.metric{padding-top:1rem}
th.metric{text-align:left;color:var(--soft);font-size:.875rem}
tbody tr:last-child>*{border-bottom:1px solid var(--rule)}
td.best{background:var(--best);font-weight:700;text-decoration:underline;text-underline-offset:3px}
td.mean{border-left:1px solid var(--rule)}
td.failed{color:var(--s4);font-style:italic}
.legend{display:flex;flex-wrap:wrap;gap:.2rem 1.2rem;padding:0;margin:.4rem 0;list-style:none;font-size:.875rem}
.legend li{display:flex;align-items:center;gap:.45rem}
.sample{width:34px;height:12px;flex:none}
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,430px),1fr));gap:1rem 1.6rem;margin:.6rem 0}
.charts figure{margin:0;max-width:600px}
.charts svg{width:100%;height:auto;display:block}
svg text{font:11px system-ui,-apple-system,"Segoe UI",Roboto,Arial,sans-serif;fill:var(--soft);text-anchor:middle}
svg text.left{text-anchor:end}svg text.name{font-size:12px;fill:var(--ink)}
.grid{stroke:var(--rule);stroke-width:.7;fill:none}.frame{stroke:var(--soft);fill:none}
.diagonal{stroke:var(--ink);stroke-width:1;stroke-dasharray:1 3}
.line{fill:none;stroke-width:1.7;stroke-linejoin:round}.marker{stroke-width:1.6}
""" + "".join(
    f".line.s{i},.marker.s{i}{{stroke:var(--s{i})}}.marker.s{i}{{fill:{'none' if i in (4, 7) else f'var(--s{i})'}}}\n"
    for i in range(8)
)

STYLE_OF_PICTURES: Final = """
figure{margin:0}
.pictures{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,var(--least,210px)),1fr));gap:.9rem}
.pictures img,.stage img{display:block;width:100%;height:auto;background:#000}
img.small{image-rendering:pixelated}
.pictures figcaption{padding-top:.2rem}
.pictures figcaption b{color:var(--ink);font-weight:600;display:block}
fieldset{border:0;padding:0;margin:.8rem 0;display:flex;flex-wrap:wrap;gap:.3rem 1.1rem;align-items:center}
legend{float:left;padding:0 .9rem 0 0;font-size:.9rem}
label{font-size:.9rem}
input,select{font:inherit;accent-color:var(--focus)}
select{padding:.15rem .3rem;max-width:100%;background:var(--shade);color:var(--ink);
border:1px solid var(--rule);border-radius:4px}
:focus-visible{outline:2px solid var(--focus);outline-offset:2px}
.compare{max-width:820px;margin:.8rem 0 1.6rem}
.compare .choice{display:flex;justify-content:space-between;gap:.6rem;margin-bottom:.4rem;flex-wrap:wrap}
.stage{position:relative;overflow:hidden;background:#000;touch-action:pan-y;cursor:ew-resize}
.stage .over{position:absolute;inset:0;clip-path:inset(0 calc(100% - var(--at,50%)) 0 0)}
.stage .edge{position:absolute;top:0;bottom:0;left:var(--at,50%);width:2px;margin-left:-1px;background:#fff;
box-shadow:0 0 0 1px #000;pointer-events:none}
.compare input[type=range]{width:100%;margin:.5rem 0 0}
.bar{height:14px;max-width:420px;border:1px solid var(--rule)}
.ticks{display:flex;justify-content:space-between;max-width:420px;font-size:.8rem;color:var(--soft)}
.key{margin:.8rem 0}
@media(max-width:600px){main,header{padding:0 14px}header{padding-top:22px}h1{font-size:1.4rem}
body{font-size:15px}.pictures{--least:150px;gap:.6rem}th,td{padding:.25rem .4rem}
th[scope=row]{white-space:normal;min-width:7.4rem;line-height:1.25}}
@media print{.compare,fieldset{display:none}}
"""

SCRIPT: Final = """
for (const part of document.querySelectorAll('[data-moments]')) {
  const moments = [...part.querySelectorAll('.moment')];
  const compare = part.querySelector('.compare');
  const [left, right] = compare.querySelectorAll('select');
  const [under, over] = compare.querySelectorAll('img');
  const range = compare.querySelector('input[type=range]');
  const stage = compare.querySelector('.stage');
  const show = () => {
    const now = moments.find(m => !m.hidden);
    for (const [image, choice] of [[over, left], [under, right]]) {
      const source = now.querySelector('img[data-name="' + CSS.escape(choice.value) + '"]');
      image.src = source.src;
      image.alt = source.alt;
    }
    stage.style.setProperty('--at', range.value + '%');
  };
  for (const radio of part.querySelectorAll('input[type=radio]'))
    radio.addEventListener('change', () => {
      moments.forEach((m, i) => { m.hidden = i != radio.value; });
      show();
    });
  for (const control of [left, right, range]) control.addEventListener('input', show);
  const drag = event => {
    if (event.type == 'pointermove' && !event.buttons) return;
    const box = stage.getBoundingClientRect();
    range.value = 100 * (event.clientX - box.left) / box.width;
    show();
  };
  stage.addEventListener('pointerdown', drag);
  stage.addEventListener('pointermove', drag);
  compare.hidden = false;
  show();
}
"""

WITHOUT_SCRIPT: Final = (
    "<noscript><style>.moment[hidden]{display:block!important}fieldset{display:none}</style></noscript>"
)
