"""The page in a real browser: nothing overflows on a phone, all text is legible in both modes, nothing is loaded."""

import re
from dataclasses import replace
from itertools import product

import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap.result import Key, Value
from jaxfinger.report.page import render

from .fabricated import STRETCHES, every, explained, trace

PAGES = ("partly", "ambiguous", "no_gap", "diverged", "not_judged")
SMALLEST = 11.0  # px
AA = 4.5  # contrast of text, WCAG 2.2, 1.4.3

# Every visible run of text: what it says, its size on the screen in px, its colour and the one behind it.
TEXTS = """() => {
  const rgba = c => { const m = c.match(/[\\d.]+/g).map(Number); return m.length < 4 ? [...m, 1] : m; };
  const over = (a, b) => [0, 1, 2].map(i => a[3] * a[i] + (1 - a[3]) * b[i]).concat(1);
  const out = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode, e = node.parentElement, text = node.textContent.trim();
    if (!text || !e.getClientRects().length || ['STYLE', 'TITLE'].includes(e.tagName.toUpperCase())) continue;
    const style = getComputedStyle(e), svg = e.closest('svg');
    if (style.visibility === 'hidden') continue;
    let scale = 1;
    if (svg) { const m = e.getScreenCTM(); scale = Math.hypot(m.a, m.b); }
    const behind = [];
    for (let p = e; p; p = p.parentElement) {
      const c = rgba(getComputedStyle(p).backgroundColor);
      behind.push(c);
      if (c[3] === 1) break;
    }
    const ground = behind.reverse().reduce((b, a) => over(a, b), [255, 255, 255, 1]);
    out.push({text, size: scale * parseFloat(style.fontSize), ground,
              colour: over(rgba(svg ? style.fill : style.color), ground)});
  }
  return out;
}"""
WIDER = """() => {
  const out = [], width = document.documentElement.clientWidth;
  for (const e of document.body.querySelectorAll('*')) {
    const r = e.getBoundingClientRect();
    if (r.right > width + 0.5 && !e.closest('.scroll') && !e.closest('svg')) out.push(e.outerHTML.slice(0, 80));
  }
  return [document.documentElement.scrollWidth - width, out];
}"""


def _luminance(colour):
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in colour[:3])]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(a, b):
    """Contrast ratio of two colours by WCAG 2.2."""
    dark, light = sorted(map(_luminance, (a, b)))
    return (light + 0.05) / (dark + 0.05)


def opened(browser, path, width, scheme):
    """The page with all details open, and the requests that it made."""
    page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    asked, said = [], []
    page.on("request", lambda r: asked.append(r.url))
    page.on("console", lambda m: said.append(m.text))
    page.goto(path.as_uri())
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    return page, asked, said


@pytest.mark.parametrize(("name", "width"), [*product(PAGES, (360,)), ("partly", 768), ("partly", 1280)])
def test_nothing_overflows(browser, pages, name, width):
    page, asked, said = opened(browser, pages[name], width, "light")
    over, wider = page.evaluate(WIDER)
    page.close()
    assert over <= 0
    assert not wider
    assert asked == [pages[name].as_uri()]
    assert not said


@pytest.mark.parametrize(
    ("name", "width", "scheme"), [*product(PAGES, (360,), ("light", "dark")), ("partly", 1280, "dark")]
)
def test_every_text_is_legible(browser, pages, name, width, scheme):
    page, _, _ = opened(browser, pages[name], width, scheme)
    found = page.evaluate(TEXTS)
    page.close()
    assert len(found) > 10
    small = {x["text"]: x["size"] for x in found if x["size"] < SMALLEST}
    faint = {x["text"]: c for x in found if (c := contrast(x["colour"], x["ground"])) < AA}
    assert not small
    assert not faint
    bright = _luminance(found[0]["ground"])
    assert bright < 0.05 if scheme == "dark" else bright > 0.8


def test_the_budget_comes_first_and_red_is_for_what_is_wrong(browser, pages):
    page, _, _ = opened(browser, pages["partly"], 1280, "light")
    first = page.evaluate("[...document.querySelectorAll('svg')].find(s => s.getClientRects().length).ariaLabel")
    assert first.startswith("Budget of the gap")
    red = "() => [...document.querySelectorAll('.wrong')].map(e => getComputedStyle(e).color)"
    assert page.evaluate(red) == []
    page.close()
    page, _, _ = opened(browser, pages["diverged"], 1280, "light")
    assert page.evaluate(red)
    page.close()


def test_each_section_is_there_when_it_has_something_to_say(pages):
    heads = {n: re.findall(r"<h2>(.*?)</h2>", p.read_text(encoding="utf-8")) for n, p in pages.items()}
    assert heads["partly"][:4] == ["How the gap is made up", "How large it is", "What causes it", "Where it lies"]
    assert "What is left" in heads["partly"]
    assert "Which cannot be told apart" in heads["ambiguous"]
    assert "What to record next" in heads["ambiguous"]
    assert "Not judged" in heads["not_judged"]
    assert "How the gap is made up" not in heads["no_gap"]
    text = pages["diverged"].read_text(encoding="utf-8")
    assert "diverges" in text
    assert "%\ufffd" not in text


def test_what_is_improbable_or_too_long_is_left_out():
    text = render(explained())
    assert "joint Stribeck" not in text  # of 2e-4
    assert "tendon creep at T3" in text  # of 4 %
    assert "&lt; 1" not in text


def test_a_cause_says_what_to_do(monkeypatch):
    cls = CATALOGUE["tendon_stretch"]
    for name, text in (("HAPPENS", "It gives."), ("LOOKS", "A slope over tension."), ("CHANGE", "Stiffen `it` <b>.")):
        monkeypatch.setattr(cls, name, text)
    page = render(explained())
    card = page.split('<article class="card"')[1].split("</article>")[0]
    for head, text in (
        ("What happens", "It gives."),
        ("What it looks like", "A slope over"),
        ("What to change", "Stiffen <code>it</code> &lt;b&gt;."),
    ):
        assert text in card.split(f"<dt>{head}</dt>")[1].split("</dd>")[0]
    assert "The law" in card
    assert "compliance: 91.0 ± 5.9 µm/N" in card


def test_what_could_hide_without_end_is_no_number():
    d = explained()
    (absorbed,) = d.absorbed
    hidden = (Value(("base",), "x", 0.0, 9e10, "rad"), Value(("base",), "y", 0.0, 0.005, "rad"))
    page = render(replace(d, absorbed=(replace(absorbed, key=Key("gravity_tilt", ("base",)), hidden=hidden),)))
    assert "gravity tilt at base, any amount of x, up to 0.56° of y" in page


def test_names_of_a_user_are_text_and_no_markup():
    d = replace(explained(), specimen="<script>alert(1)</script>", data='a"><img src=x>.h5')
    mine = replace(STRETCHES, effect="mine", sites=(("<b>",),))
    text = render(replace(d, named=(Key("mine", ("<b>",)),), budget=(mine,)))
    assert "<script" not in text
    assert "<img" not in text
    assert "<b>" not in re.sub(r"<svg.*?</svg>", "", text, flags=re.S)


@pytest.mark.parametrize("name", sorted(set(every()) - set(PAGES)))
def test_every_kind_of_diagnosis_has_a_page(name):
    d = every()[name]
    text = render(d, trace())
    assert d.specimen in text
    assert not re.search(
        r"\b(nan|inf|None)\b(?! of)", re.sub(r"<svg.*?</svg>", "", text, flags=re.S).split("</style>")[1]
    )
