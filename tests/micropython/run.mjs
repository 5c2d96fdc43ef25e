// Runs Python code in MicroPython's WebAssembly build. Arguments: the module's file. Standard input: one JSON job,
//   {"files": {"path in MicroPython's file system": "base64"}, "calls": ["code", ...], "pystack": words}.
// What the code prints goes to standard output; an exception ends the run with status 1.
// Each call is a run from the top: this build collects garbage between such runs and never within one.
import { readFileSync, writeSync } from "node:fs";
import { pathToFileURL } from "node:url";

const job = JSON.parse(readFileSync(0, "utf8"));
const { loadMicroPython } = await import(pathToFileURL(process.argv[2]).href);

const lines = [];
const python = await loadMicroPython({
    pystack: job.pystack,
    stdout: (line) => lines.push(line),
    stderr: (line) => process.stderr.write(line + "\n"),
    linebuffer: true,
});

function writeFile(path, base64) {
    const folders = path.split("/").slice(1, -1);
    let folder = "";
    for (const name of folders) {
        folder += "/" + name;
        if (!python.FS.analyzePath(folder).exists) python.FS.mkdir(folder);
    }
    python.FS.writeFile(path, Buffer.from(base64, "base64"));
}

// A pipe may take less than all at once, or nothing just now.
function writeAll(bytes) {
    for (let done = 0; done < bytes.length; ) {
        try {
            done += writeSync(1, bytes, done);
        } catch (error) {
            if (error.code !== "EAGAIN") throw error;
        }
    }
}

for (const [path, base64] of Object.entries(job.files)) writeFile(path, base64);
try {
    for (const call of job.calls) python.runPython(call);
} catch (error) {
    process.stderr.write(`${error.message}\n`);
    process.exitCode = 1;
}
writeAll(Buffer.from(lines.map((line) => line + "\n").join("")));
