/* A libmodbus server and a libmodbus client, to hold the Modbus driver against.
 *
 * As a program: `exchange tcp` serves on a free port of 127.0.0.1, prints it, and takes any
 * number of connections; `exchange rtu FD` serves unit 1 on an open descriptor, the far end
 * of a pty. As a library: client_tcp, client_rtu and exchange, the client's side of one sample.
 */
#include <errno.h>
#include <modbus/modbus.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

enum { REGISTERS = 16, WRITE_AT = 0, READ_AT = 0, WORDS = 2 };

modbus_t *client_tcp(int port) {
    modbus_t *context = modbus_new_tcp("127.0.0.1", port);
    if (context == NULL || modbus_connect(context) != 0)
        return NULL;
    return context;
}

modbus_t *client_rtu(const char *device, int baud) {
    modbus_t *context = modbus_new_rtu(device, baud, 'N', 8, 1);
    if (context == NULL || modbus_set_slave(context, 1) != 0 || modbus_connect(context) != 0)
        return NULL;
    return context;
}

/* Write `value` and read it back with function 23, `count` times; times[i] in ns. */
int exchange(modbus_t *context, int count, float value, float *read, long long *times) {
    uint16_t out[WORDS], in[WORDS];
    uint32_t bits;
    struct timespec before, after;
    for (int i = 0; i < count; i++) {
        clock_gettime(CLOCK_MONOTONIC, &before);
        memcpy(&bits, &value, sizeof bits); /* modbus_set_float_abcd swaps bytes in 3.1.6 */
        out[0] = bits >> 16;
        out[1] = bits & 0xffff;
        if (modbus_write_and_read_registers(context, WRITE_AT, WORDS, out, READ_AT, WORDS, in) != WORDS)
            return errno ? errno : -1;
        bits = (uint32_t)in[0] << 16 | in[1];
        memcpy(read, &bits, sizeof bits);
        clock_gettime(CLOCK_MONOTONIC, &after);
        times[i] = (after.tv_sec - before.tv_sec) * 1000000000LL + (after.tv_nsec - before.tv_nsec);
    }
    return 0;
}

static int answer(modbus_t *context, modbus_mapping_t *mapping) {
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    int size = modbus_receive(context, query);
    if (size > 0)
        return modbus_reply(context, query, size, mapping);
    return size;
}

static int serve_tcp(modbus_mapping_t *mapping) {
    modbus_t *context = modbus_new_tcp("127.0.0.1", 0);
    int listener = modbus_tcp_listen(context, 4);
    struct sockaddr_in address;
    socklen_t length = sizeof address;
    fd_set all, ready;
    int highest = listener;
    if (listener < 0 || getsockname(listener, (struct sockaddr *)&address, &length) != 0)
        return 1;
    printf("%d\n", ntohs(address.sin_port));
    fflush(stdout);
    FD_ZERO(&all);
    FD_SET(listener, &all);
    for (;;) {
        ready = all;
        if (select(highest + 1, &ready, NULL, NULL, NULL) < 0)
            return 1;
        for (int fd = 0; fd <= highest; fd++) {
            if (!FD_ISSET(fd, &ready))
                continue;
            if (fd == listener) {
                int made = modbus_tcp_accept(context, &listener);
                if (made < 0)
                    return 1;
                FD_SET(made, &all);
                highest = made > highest ? made : highest;
                continue;
            }
            modbus_set_socket(context, fd);
            if (answer(context, mapping) < 0) {
                close(fd);
                FD_CLR(fd, &all);
            }
        }
    }
}

static int serve_rtu(modbus_mapping_t *mapping, int fd) {
    modbus_t *context = modbus_new_rtu("/dev/null", 115200, 'N', 8, 1);
    modbus_set_slave(context, 1);
    modbus_set_socket(context, fd);
    modbus_set_indication_timeout(context, 0, 0);
    printf("ready\n");
    fflush(stdout);
    for (;;)
        if (answer(context, mapping) < 0 && errno != EMBBADCRC && errno != ETIMEDOUT)
            return 1;
}

int main(int count, char **words) {
    modbus_mapping_t *mapping = modbus_mapping_new(0, 0, REGISTERS, 0);
    if (count == 2 && strcmp(words[1], "tcp") == 0)
        return serve_tcp(mapping);
    if (count == 3 && strcmp(words[1], "rtu") == 0)
        return serve_rtu(mapping, atoi(words[2]));
    fprintf(stderr, "usage: exchange tcp | rtu FD\n");
    return 2;
}
