# SPDX-License-Identifier: Apache-2.0

"""What on a page has too little contrast, as WCAG 2.2 asks for in level AA."""

FUNCTIONS = """
  const parse = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = (rgb) => rgb.slice(0, 3).map((part) => part / 255)
    .map((part) => part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4)
    .reduce((sum, part, which) => sum + part * [0.2126, 0.7152, 0.0722][which], 0);
  const ground = (element) => {
    const found = parse(getComputedStyle(element).backgroundColor);
    return found[3] === 0 && element.parentElement ? ground(element.parentElement) : found; };
  const ratio = (one, other) => (Math.max(one, other) + 0.05) / (Math.min(one, other) + 0.05);
"""
"""Of colours as a page has them, to the ratio of two luminances."""

TEXTS = f"""() => {{ {FUNCTIONS}
  const poor = [];
  for (const element of document.querySelectorAll('body *')) {{
    const has_text = [...element.childNodes].some((one) => one.nodeType === 3 && one.data.trim());
    if (!has_text || !element.getClientRects().length) continue;
    const style = getComputedStyle(element);
    const ink = element.closest('svg') ? style.fill : style.color;
    const both = [parse(ink), ground(element)].map(light);
    if (ratio(...both) < 4.5) poor.push(`${{element.outerHTML.slice(0, 60)}} ${{ratio(...both)}}`);
  }}
  return poor; }}"""
"""Returns the texts below the 4.5 of 1.4.3."""

LINES = f"""(selector) => {{ {FUNCTIONS}
  return [...document.querySelectorAll(selector)]
    .map((line) => [line.outerHTML.slice(0, 60), parse(getComputedStyle(line).stroke)])
    .filter(([line, ink]) => ratio(light(ink), light(ground(document.body))) < 3); }}"""
"""Returns the lines of drawings below the 3 of 1.4.11."""
