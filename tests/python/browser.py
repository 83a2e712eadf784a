"""A page in a headless Chromium, driven over its pipe: what a script says, real clicks, pictures."""
import base64
import json
import os
import subprocess
import tempfile
import time

LONGEST_WAIT_S = 240
AGAIN_S = 0.1


class Page:
    def __init__(self, url, size=(1100, 700)):
        self.directory = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        to_browser, self.write_end = os.pipe()
        self.read_end, from_browser = os.pipe()
        # The browser reads its descriptor 3 and writes its descriptor 4; first aside, lest one takes the other's place.
        far = [os.dup2(end, 60 + i, inheritable=True) for i, end in enumerate((to_browser, from_browser))]

        def place():
            os.dup2(far[0], 3)
            os.dup2(far[1], 4)

        options = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
                   "--disable-component-update", "--disable-sync", "--remote-debugging-pipe",
                   f"--user-data-dir={self.directory.name}", f"--window-size={size[0]},{size[1]}"]
        self.process = subprocess.Popen(["chromium", *options], preexec_fn=place, close_fds=False,
                                        stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        for end in (to_browser, from_browser, *far):
            os.close(end)
        self.number, self.session, self.rest = 0, None, b""
        target = self.call("Target.createTarget", url=url, newWindow=True, width=size[0], height=size[1])["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.wait("location.href !== 'about:blank' && document.readyState === 'complete'")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        os.close(self.write_end)
        self.process.terminate()
        self.process.wait()
        os.close(self.read_end)
        self.directory.cleanup()

    def call(self, method, **parameters):
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.write_end, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self.rest:
                some = os.read(self.read_end, 1 << 16)
                assert some, "chromium has gone"
                self.rest += some
            answer, self.rest = self.rest.split(b"\0", 1)
            answer = json.loads(answer)
            if answer.get("id") == self.number:
                assert "error" not in answer, (method, answer)
                return answer["result"]

    def evaluate(self, expression):
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, (expression, result)
        return result["result"].get("value")

    def wait(self, expression):
        """Until an expression of the page is true."""
        end = time.monotonic() + LONGEST_WAIT_S
        while not self.evaluate(expression):
            assert time.monotonic() < end, (expression, self.evaluate("document.body.innerText"))
            time.sleep(AGAIN_S)

    def click(self, x, y):
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def picture(self, file):
        shot = self.call("Page.captureScreenshot", format="png")
        with open(file, "wb") as out:
            out.write(base64.b64decode(shot["data"]))
