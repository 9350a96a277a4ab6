// A page opened from disk may not start a worker, which the search is. There, an iframe takes the worker's place.
if (location.protocol === "file:") {
  const inside = `
    <script>
      importScripts = (...urls) => urls.reduce((done, url) => done.then(() => new Promise((loaded, failed) => {
        const script = document.createElement("script")
        script.src = url
        script.onload = loaded
        script.onerror = failed
        document.body.appendChild(script)
      })), Promise.resolve())
      postMessage = message => parent.postMessage(message, "*")
    <\/script>
  `
  window.IFrameWorker = window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.onmessage = null
      const frame = document.createElement("iframe")
      frame.hidden = true
      frame.srcdoc = `<!doctype html><html><body>${inside}<script src="${new URL(url, location.href)}"><\/script></body></html>`
      this.ready = new Promise(resolve => (frame.onload = () => resolve(frame.contentWindow)))
      window.addEventListener("message", event => {
        if (event.source !== frame.contentWindow) return
        const message = new MessageEvent("message", { data: event.data })
        this.dispatchEvent(message)
        if (this.onmessage) this.onmessage(message)
      })
      document.body.appendChild(frame)
    }
    postMessage(message) {
      // Not by `inside.postMessage`, which is the program's way out.
      this.ready.then(inside => inside.dispatchEvent(new MessageEvent("message", { data: message })))
    }
    terminate() {}
  }
}
