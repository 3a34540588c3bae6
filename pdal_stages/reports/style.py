"""The look of every report: colours for light and dark pages, and the style sheet."""

from __future__ import annotations

#: Colours as red, green, blue from 0 to 255, for a light and a dark page. Text on `page` and on
#: `panel` keeps a contrast of 4.5 or more (WCAG 2.1 AA); so does `ink` on the darkest heat cell.
PALETTE: dict[str, dict[str, tuple[int, int, int]]] = {
    "light": {
        "page": (250, 250, 248),
        "panel": (255, 255, 255),
        "ink": (24, 29, 35),
        "muted": (88, 97, 108),
        "rule": (217, 221, 226),
        "right": (31, 111, 178),
        "wrong": (196, 78, 22),
    },
    "dark": {
        "page": (19, 22, 26),
        "panel": (28, 32, 37),
        "ink": (232, 235, 239),
        "muted": (163, 172, 183),
        "rule": (58, 65, 74),
        "right": (82, 160, 224),
        "wrong": (238, 137, 82),
    },
}
#: The most a heat cell takes of its colour.
HEAT = 0.5


def _variables(scheme: str) -> str:
    return "".join(f"--{name}:{r} {g} {b};" for name, (r, g, b) in PALETTE[scheme].items())


_SHEET = """
:root{color-scheme:light dark;@light@}
@media (prefers-color-scheme:dark){:root{@dark@}}
*{box-sizing:border-box}
body{margin:0;background:rgb(var(--page));color:rgb(var(--ink));
 font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Liberation Sans",Arial,sans-serif}
main{max-width:1240px;margin:0 auto;padding:32px 24px 48px}
header{border-bottom:2px solid rgb(var(--ink));padding-bottom:14px;margin-bottom:24px}
h1{font-size:28px;line-height:1.2;margin:0 0 4px;font-weight:650;letter-spacing:-.01em}
h2{font-size:19px;line-height:1.3;margin:0 0 4px;font-weight:650}
h3{font-size:15px;margin:0 0 6px;font-weight:600}
section{margin:0 0 36px}
p{margin:0 0 12px;max-width:78ch}
.note,.sub,figcaption,caption,summary,footer{color:rgb(var(--muted));font-size:13.5px}
.sub{font-size:15px;margin:0}
.note{margin-bottom:12px}
.lead{font-size:17px}
ul.plain{list-style:none;margin:0;padding:0}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(150px,1fr));gap:1px;margin:1px 1px 17px}
.tiles>div{box-shadow:0 0 0 1px rgb(var(--rule));
 background:rgb(var(--panel));padding:12px 16px;display:flex;flex-direction:column}
.tiles dt{order:2;color:rgb(var(--muted));font-size:13.5px}
.tiles dd{margin:0;font-size:27px;line-height:1.2;font-weight:600;font-variant-numeric:tabular-nums}
.tiles dd small{font-size:15px;font-weight:400;color:rgb(var(--muted))}
.tiles dd.more{order:3;font-size:12.5px;line-height:1.35;font-weight:400;color:rgb(var(--muted))}
.scroll{overflow-x:auto;margin:0 0 12px}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:14px}
table.wide{width:100%}
caption{text-align:left;padding:0 0 6px;caption-side:top}
caption b{color:rgb(var(--ink));font-size:15px;font-weight:600}
th,td{padding:5px 10px;text-align:right;border-bottom:1px solid rgb(var(--rule));white-space:nowrap}
th{font-weight:600}
thead th{vertical-align:bottom;color:rgb(var(--muted));font-size:13px;border-bottom-color:rgb(var(--muted))}
th.text,td.text{text-align:left}
td.break{white-space:normal;overflow-wrap:anywhere;min-width:12ch}
tbody th{font-weight:500}
th.heat{white-space:normal;min-width:62px;max-width:100px;font-size:12.5px;line-height:1.3}
th.heat,td.heat{padding:5px 7px}
tfoot>tr>*{font-weight:600;border-top:1px solid rgb(var(--muted))}
section>.scroll+.scroll{margin-top:28px}
.strip>div{min-width:860px}
.strip figure+figure{margin-top:16px}
td.heat{border:1px solid rgb(var(--panel));line-height:1.25}
td.heat small{display:block;font-size:11.5px}
td.right{background:rgb(var(--right)/calc(var(--v)*@heat@))}
td.wrong{background:rgb(var(--wrong)/calc(var(--v)*@heat@))}
td.bar{min-width:104px}
td.bar i{display:block;height:4px;margin-top:3px;background:rgb(var(--rule))}
td.bar i b{display:block;height:4px;background:rgb(var(--right))}
.swatch{display:inline-block;width:12px;height:12px;margin-right:7px;vertical-align:-1px;
 border:1px solid rgb(var(--ink)/.35)}
.legend{display:flex;flex-wrap:wrap;gap:4px 18px;font-size:13.5px;margin:0 0 12px;padding:0;list-style:none}
.grid{display:grid;gap:20px;grid-template-columns:repeat(auto-fit,minmax(min(100%,var(--least,300px)),1fr))}
.grid>*{min-width:0}
figure{margin:0}
figcaption{padding-top:6px}
.map{position:relative;line-height:0;border:1px solid rgb(var(--rule));background:rgb(var(--panel))}
.map img{width:100%;height:auto;display:block}
.map svg{position:absolute;inset:0;width:100%;height:100%}
.scale{display:flex;align-items:center;gap:8px;font-size:12.5px;color:rgb(var(--muted));margin-top:6px}
.scale i{display:block;height:6px;border:1px solid rgb(var(--muted));border-top:0;flex:none}
svg.chart{width:100%;max-width:560px;height:auto;display:block;font-size:13px;overflow:visible}
svg.chart text{fill:rgb(var(--muted))}
svg.chart text.value{fill:rgb(var(--ink));font-size:12px}
svg.chart .axis{stroke:rgb(var(--muted));fill:none}
svg.chart .gridline{stroke:rgb(var(--rule));fill:none}
svg.chart .line{stroke:rgb(var(--right));fill:none;stroke-width:2.5}
svg.chart .dot{fill:rgb(var(--right));stroke:rgb(var(--page));stroke-width:1.5}
svg.chart .ideal{stroke:rgb(var(--muted));fill:none;stroke-dasharray:5 4}
svg.chart .faint{fill:rgb(var(--right)/.22)}
svg.chart .solid{fill:rgb(var(--right))}
svg.chart .bad{fill:rgb(var(--wrong))}
.bars{display:grid;grid-template-columns:auto minmax(60px,1fr) auto;gap:5px 12px;align-items:center;
 margin:0;max-width:760px;font-size:14px;font-variant-numeric:tabular-nums}
.bars dt{overflow-wrap:anywhere}
.bars dd{margin:0;text-align:right}
.bars dd i{display:block;height:11px;background:rgb(var(--right))}
details{margin:8px 0 0}
summary{cursor:pointer}
footer{border-top:1px solid rgb(var(--rule));padding-top:12px}
@media (max-width:640px){main{padding:20px 16px 32px}h1{font-size:23px}.lead{font-size:16px}
 th,td{padding:5px 7px}td.bar{min-width:72px}.tiles{grid-template-columns:repeat(2,1fr)}
 .tiles>div{padding:10px 12px}.tiles dd{font-size:23px}}
@media print{:root{color-scheme:light;@light@--page:255 255 255}
 *{print-color-adjust:exact;-webkit-print-color-adjust:exact}
 body{font-size:10.5pt}main{max-width:none;padding:0}.scroll{overflow:visible}.strip>div{min-width:0}
 section{margin-bottom:20px}figure,table,.tiles,.bars{break-inside:avoid}h2,h2+.note,h3{break-after:avoid}
 .grid.row{grid-template-columns:repeat(auto-fit,minmax(0,1fr));grid-auto-flow:column}
 .tiles{grid-template-columns:repeat(6,1fr)}.tiles>div{padding:8px 10px}.tiles dd{font-size:19px}
 @page{margin:15mm}}
"""


def style_sheet() -> str:
    """The CSS of a report, with the palette filled in."""
    sheet = _SHEET.replace("@heat@", str(HEAT))
    return sheet.replace("@light@", _variables("light")).replace("@dark@", _variables("dark"))
