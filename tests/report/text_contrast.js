/* Contrast of every visible text of a page, also inside SVG, against what is painted below it (WCAG 2.2, 1.4.3). */
() => {
  const parsed = (text) => {
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = 1;
    const pen = canvas.getContext("2d", { willReadFrequently: true });
    pen.fillStyle = text;
    pen.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = pen.getImageData(0, 0, 1, 1).data;
    return [r, g, b, a / 255];
  };
  const memory = new Map();
  const color = (text) => {
    if (!memory.has(text)) memory.set(text, parsed(text));
    return memory.get(text);
  };
  const over = (top, below) => [0, 1, 2].map((k) => top[3] * top[k] + (1 - top[3]) * below[k]);
  const luminance = (rgb) => {
    const [r, g, b] = rgb.map((v) => (v / 255 <= 0.04045 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const contrast = (a, b) => {
    const [x, y] = [luminance(a), luminance(b)].sort((p, q) => q - p);
    return (x + 0.05) / (y + 0.05);
  };
  const opacity = (element) => {
    let product = 1;
    for (let e = element; e; e = e.parentElement) product *= Number(getComputedStyle(e).opacity);
    return product;
  };
  const isSvg = (element) => element instanceof SVGElement && element.tagName !== "svg";
  /* What an element paints below a text: a color with alpha; null where it is an image. */
  const paint = (element) => {
    const style = getComputedStyle(element);
    if (isSvg(element)) {
      if (["text", "tspan", "g"].includes(element.tagName)) return [0, 0, 0, 0];
      if (element.tagName === "image" || style.fill.startsWith("url")) return null;
      if (style.fill === "none") return [0, 0, 0, 0];
      const fill = color(style.fill);
      return [...fill.slice(0, 3), fill[3] * Number(style.fillOpacity) * opacity(element)];
    }
    if (["IMG", "CANVAS", "VIDEO"].includes(element.tagName)) return null;
    const ground = color(style.backgroundColor);
    return [...ground.slice(0, 3), ground[3] * opacity(element)];
  };
  const background = (element, x, y) => {
    const stack = document.elementsFromPoint(x, y);
    const at = stack.indexOf(element);
    if (at < 0) return undefined; // clipped, or covered
    const layers = [];
    const isDark = matchMedia("(prefers-color-scheme: dark)").matches;
    let grounds = [isDark ? [18, 18, 18] : [255, 255, 255]];
    for (const below of stack.slice(isSvg(element) ? at + 1 : at)) {
      const painted = paint(below);
      if (painted === null) {
        // Of an image nothing is known: it may be white or black, under layers that cover most of it.
        if (layers.reduce((left, layer) => left * (1 - layer[3]), 1) > 0.5) return null;
        grounds = [[0, 0, 0], [255, 255, 255]];
        break;
      }
      layers.push(painted);
      if (painted[3] > 0.999) break;
    }
    layers.reverse();
    return grounds.map((ground) => layers.reduce((sum, layer) => over(layer, sum), ground));
  };
  document.head.append(Object.assign(document.createElement("style"), { textContent: "*{pointer-events:auto!important}" }));
  for (const details of document.querySelectorAll("details")) details.open = true;
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const found = [];
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const element = node.parentElement;
    if (!node.textContent.trim() || ["SCRIPT", "STYLE", "TITLE", "OPTION", "NOSCRIPT"].includes(element.tagName)) continue;
    if (!element.checkVisibility({ opacityProperty: true, visibilityProperty: true })) continue;
    element.scrollIntoView({ block: "center", inline: "center", behavior: "instant" });
    const range = document.createRange();
    range.selectNodeContents(node);
    const box = range.getBoundingClientRect();
    if (box.width < 1.5 || box.height < 1.5) continue; // for screen readers alone
    const style = getComputedStyle(element);
    const ink = color(isSvg(element) ? style.fill : style.color);
    const alpha = ink[3] * opacity(element) * (isSvg(element) ? Number(style.fillOpacity) : 1);
    const isBold = Number(style.fontWeight) >= 700;
    const isLarge = parseFloat(style.fontSize) >= (isBold ? 18.66 : 24);
    const grounds = [0.1, 0.5, 0.9].map((part) => background(element, box.left + part * box.width, box.top + 0.5 * box.height));
    const known = grounds.filter((ground) => ground).flat();
    found.push({
      text: node.textContent.trim().slice(0, 40),
      isSvg: isSvg(element),
      isKnown: known.length > 0,
      isOverPicture: grounds.includes(null),
      needed: isLarge ? 3 : 4.5,
      contrast: known.length ? Math.min(...known.map((g) => contrast(over([...ink.slice(0, 3), alpha], g), g))) : null,
    });
  }
  return found;
}
