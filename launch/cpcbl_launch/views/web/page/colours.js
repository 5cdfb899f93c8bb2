// The colours of the style sheet, for canvases: read again when the theme changes.
let known = {};

export function ink(name) {
  known[name] ??= getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
  return known[name];
}

export function forgetInks() {
  known = {};
}
