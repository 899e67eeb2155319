// Contents of elements that change with every frame, by number of the element.

const contents = new Map(), elements = new Map();

// A field that the user is changing keeps what was typed.
function isHeld(element) {
  return element.matches(element.type === "range" ? ":active" : ":focus");
}

function apply(number) {
  const element = elements.get(number), content = contents.get(number);
  if (!element || !content) return;
  if (content.value !== undefined && !isHeld(element)) element.value = content.value;
  if (content.text !== undefined && element.textContent !== content.text) element.textContent = content.text;
  if (content.state !== undefined) element.dataset.state = content.state;
}

export function attach(number, element) {
  elements.set(number, element);
  apply(number);
}

export function detach(number) {
  elements.delete(number);
}

// all: { number: { text, state }, { value } or { moment } }
export function setContents(all) {
  for (const [number, content] of Object.entries(all)) {
    const isMoved = content.moment !== contents.get(Number(number))?.moment;
    contents.set(Number(number), content);
    if (isMoved) window.skysimMoment?.(Number(content.moment)); // the line over the strips
    apply(Number(number));
  }
}
