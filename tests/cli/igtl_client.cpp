// Receives messages with the reference library of OpenIGTLink, which 3D Slicer uses, and prints a line for each.
//   igtl_client PORT COUNT
// Messages whose checksum is wrong end the program.
#include <igtlClientSocket.h>
#include <igtlImageMessage.h>
#include <igtlPolyDataMessage.h>
#include <igtlTimeStamp.h>
#include <igtlTransformMessage.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <list>
#include <string>

static const int CHECK = 1;

static void fail(const char *what) {
    std::fprintf(stderr, "%s\n", what);
    std::exit(1);
}

static void receive(igtl::ClientSocket *socket, void *to, igtlUint64 bytes) {
    if (socket->Receive(to, static_cast<int>(bytes)) != static_cast<int>(bytes)) fail("the connection ended");
}

template <class Message> static typename Message::Pointer body(igtl::ClientSocket *socket, igtl::MessageHeader *header) {
    typename Message::Pointer message = Message::New();
    message->SetMessageHeader(header);
    message->AllocatePack();
    receive(socket, message->GetPackBodyPointer(), message->GetPackBodySize());
    if (!(message->Unpack(CHECK) & igtl::MessageHeader::UNPACK_BODY)) fail("the checksum or the body is wrong");
    return message;
}

static void print(const igtl::Matrix4x4 &matrix) {
    for (int row = 0; row < 3; ++row)
        for (int column = 0; column < 4; ++column) std::printf(" %.5f", matrix[row][column]);
}

int main(int argc, char **argv) {
    if (argc != 3) fail("usage: igtl_client PORT COUNT");
    igtl::ClientSocket::Pointer socket = igtl::ClientSocket::New();
    if (socket->ConnectToServer("127.0.0.1", std::atoi(argv[1])) != 0) fail("no server is there");
    for (int count = std::atoi(argv[2]); count > 0; --count) {
        igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
        header->InitPack();
        receive(socket, header->GetPackPointer(), header->GetPackSize());
        header->Unpack();
        const std::string type = header->GetDeviceType();
        igtl::TimeStamp::Pointer sent = igtl::TimeStamp::New(), now = igtl::TimeStamp::New();
        header->GetTimeStamp(sent);
        now->GetTime();
        std::printf("%s %s %.6f", type.c_str(), header->GetDeviceName(), now->GetTimeStamp() - sent->GetTimeStamp());
        if (type == "TRANSFORM") {
            igtl::TransformMessage::Pointer message = body<igtl::TransformMessage>(socket, header);
            igtl::Matrix4x4 matrix;
            message->GetMatrix(matrix);
            print(matrix);
        } else if (type == "IMAGE") {
            igtl::ImageMessage::Pointer message = body<igtl::ImageMessage>(socket, header);
            int size[3];
            float spacing[3];
            message->GetDimensions(size);
            message->GetSpacing(spacing);
            igtl::Matrix4x4 matrix;
            message->GetMatrix(matrix);
            std::printf(" %d %d %d %d %d %.5f %.5f", size[0], size[1], size[2], message->GetScalarType(),
                        message->GetEndian(), spacing[0], spacing[1]);
            print(matrix);
        } else if (type == "POLYDATA") {
            igtl::PolyDataMessage::Pointer message = body<igtl::PolyDataMessage>(socket, header);
            igtl::PolyDataPointArray::Pointer points = message->GetPoints();
            igtl::PolyDataCellArray::Pointer lines = message->GetLines();
            unsigned int in_lines = 0, highest = 0;
            for (unsigned int line = 0; line < lines->GetNumberOfCells(); ++line) {
                std::list<igtlUint32> cell;
                lines->GetCell(line, cell);
                in_lines += cell.size();
                highest = std::max(highest, *std::max_element(cell.begin(), cell.end()));
            }
            igtl::PolyDataAttribute *radius = message->GetAttribute(0);
            std::printf(" %d %u %u %u %s %u", points->GetNumberOfPoints(), (unsigned)lines->GetNumberOfCells(), in_lines, highest,
                        radius->GetName(), (unsigned)radius->GetSize());
            igtlFloat32 point[3], size;
            points->GetPoint(0, point);
            radius->GetNthData(0, &size);
            std::printf(" %.4f %.4f %.4f %.4f", point[0], point[1], point[2], size);
        } else {
            fail("a message of an unknown type");
        }
        std::printf("\n");
    }
    return 0;
}
