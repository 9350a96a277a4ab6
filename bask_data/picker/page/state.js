"use strict";

// What the page knows, and small questions about it. A frame is [recording, camera, number]; (u, v) are pixels of its
// image, whose centres are integers. Everything else lies in CSS pixels.

const TOKEN = new URLSearchParams(location.search).get("token") || "";
const N_OTHERS = 8; // views beside the main one, at most: each makes a move of the pointer take some 5 ms longer

const state = { marks: [], can_undo: false, can_redo: false, is_saved: false, recordings: [] };
const views = [];
let chosen = ""; // name of the keypoint that is chosen
let hovered = null; // {view, u, v}: under the pointer, or under the keyboard's cross
let dragged = null; // {name, view, u, v, x, y, hasMoved}: pressed, and not yet let go

const $ = (id) => document.getElementById(id);
const blank = () => document.createElement("canvas");
const between = (value, low, high) => Math.max(low, Math.min(value, high));
const clamp = (value, size) => between(value, 0, size - 1);

const same = (a, b) => a[0] === b[0] && a[1] === b[1] && a[2] === b[2];
const key = (frame) => frame.join("\n");
const frameOf = (mark) => [mark.recording, mark.camera, mark.frame];
const recordingOf = (frame) => state.recordings.find((recording) => recording.name === frame[0]);
const camerasOf = (frame) => recordingOf(frame).cameras;
const cameraOf = (frame) => camerasOf(frame).find((camera) => camera.name === frame[1]) || camerasOf(frame)[0];
const markOf = (name) => state.marks.find((mark) => mark.name === name);
const shownViews = () => views.filter((view) => view.isShown && view.frame);
