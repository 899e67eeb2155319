// Search in pages that are opened as files. Browsers refuse `new Worker` there; this runs the worker's script in a
// hidden frame of the same page. The theme's offline plugin takes a script of this name in place of one from the net.
if (location.protocol === "file:") {
  window.IFrameWorker = window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.appendChild(frame);
      const page = frame.contentDocument;
      page.open();
      this.scope = frame.contentWindow;
      this.scope.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      this.scope.importScripts = (...urls) => Promise.all(urls.map((source) => this.load(page, source)));
      this.ready = new Promise((done) => frame.addEventListener("load", done));
      page.write(`<script src="${new URL(url, document.baseURI)}"></script>`);
      page.close();
    }

    postMessage(data) {
      this.ready.then(() => this.scope.dispatchEvent(new MessageEvent("message", { data })));
    }

    load(page, source) {
      return new Promise((done, failed) => {
        const script = Object.assign(page.createElement("script"), { src: source, onload: done, onerror: failed });
        page.head.appendChild(script);
      });
    }

    terminate() {
      this.scope.frameElement.remove();
    }
  };
}
