/* Print every touch message. Build: cc -o listen listen.c -lzmq
   The default address is the service's; a touchd started by hand publishes at tcp://127.0.0.1:5570. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <zmq.h>

/* Receive one part of a message as a string; a part that is too long is cut. Returns its length, or -1. */
static int receive(void *socket, char *text, size_t size)
{
    int length = zmq_recv(socket, text, size - 1, 0);
    if (length >= 0)
        text[(size_t)length < size ? (size_t)length : size - 1] = '\0';
    return length;
}

/* Return a number of the payload by its name, with quotes and colon; -1 if there is none. */
static long long number(const char *payload, const char *name)
{
    const char *field = strstr(payload, name);
    return field ? strtoll(field + strlen(name), NULL, 10) : -1;
}

int main(int argc, char **argv)
{
    const char *address = argc > 1 ? argv[1] : "ipc:///run/touchd/bus";
    char topic[32], payload[65536];
    long long last_seq = -1, last_t_ns = -1;
    void *context = zmq_ctx_new();
    void *socket = zmq_socket(context, ZMQ_SUB);

    if (zmq_connect(socket, address) != 0) {
        fprintf(stderr, "%s: %s\n", address, zmq_strerror(zmq_errno()));
        return 1;
    }
    zmq_setsockopt(socket, ZMQ_SUBSCRIBE, "touch", strlen("touch"));

    while (receive(socket, topic, sizeof topic) >= 0 && receive(socket, payload, sizeof payload) >= 0) {
        /* For brevity: a real program hands the payload to its JSON parser. */
        long long seq = number(payload, "\"seq\":"), t_ns = number(payload, "\"t_ns\":");
        if (seq == last_seq && t_ns == last_t_ns)
            continue; /* sent once more for another subscriber's sake */
        if (last_seq >= 0 && seq > last_seq + 1)
            fprintf(stderr, "%lld messages lost\n", seq - last_seq - 1);
        last_seq = seq;
        last_t_ns = t_ns;
        puts(payload);
        fflush(stdout);
    }
    zmq_close(socket);
    zmq_ctx_term(context);
    return 0;
}
