// Modbus TCP servers from npm, one a process: node servers.cjs modbus-serial | jsmodbus
//
// Each holds 16 holding registers of unit 1 from address 0 on, all 0. It prints its port once it
// answers, and serves until it is killed. Neither knows function 23.
"use strict";
const net = require("node:net");

const REGISTERS = 16;
const HOST = "127.0.0.1";

function serveModbusSerial() {
  const { ServerTCP } = require("modbus-serial");
  const registers = new Uint16Array(REGISTERS);
  const at = (address) => {
    if (address >= REGISTERS) throw Object.assign(new Error("no register"), { modbusErrorCode: 2 });
    return address;
  };
  const vector = {
    getHoldingRegister: (address) => registers[at(address)],
    setRegister: (address, value) => {
      registers[at(address)] = value;
    },
  };
  const finder = net.createServer().listen(0, HOST, () => {
    const { port } = finder.address(); // it takes port 0 for its default, 502
    finder.close(() => {
      const server = new ServerTCP(vector, { host: HOST, port, unitID: 1 });
      server.on("initialized", () => console.log(port));
    });
  });
}

function serveJsmodbus() {
  const { ModbusTCPServer } = require("jsmodbus");
  const server = net.createServer();
  // It leaves errors of a connection to its host: without this, one that is reset ends the process.
  server.on("connection", (socket) => socket.on("error", () => {}));
  new ModbusTCPServer(server, { holding: Buffer.alloc(2 * REGISTERS) });
  server.listen(0, HOST, () => console.log(server.address().port));
}

({ "modbus-serial": serveModbusSerial, jsmodbus: serveJsmodbus })[process.argv[2]]();
